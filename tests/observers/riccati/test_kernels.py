"""The kernels of the paper's observer against the oracles, and that they stay healthy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from coopenv.api.engine import Engine
from coopenv.estimation.poses import position_covariance
from coopenv.observers import registry
from coopenv.observers import run as run_observer
from coopenv.observers.pose_filters import DeadReckoning
from coopenv.runs.recorder import record
from coopenv.scenario import Scenario, load_scenario
from coopenv.world.world import World
from tests.helpers.builders import (
    LANDMARKS,
    constant,
    errors,
    estimated_position,
    from_oracle,
    landmark,
    run,
    same_bits,
    scenario,
    start,
    vehicle,
)
from tests.helpers.recordings import completed
from tests.oracles import continuous
from tests.oracles.batch import small_errors

LEVER = (0.3, -0.1, 0.2)
ESTIMATE = ("estimate_rotation", "estimate_position", "covariance")
POSES = ("rotation", "position", *ESTIMATE[:2])


OFF = {"position_offset": [0.4, -0.3, 0.2], "orientation_offset_wxyz": [0.98, 0.0, 0.0, 0.198997487]}


def test_gains_per_vehicle_are_those_of_worlds_with_one_gain() -> None:
    """Of three vehicles that see landmarks alone."""
    gains, names = (0.7, 1.0, 6.0), [f"L{i + 1}" for i in range(len(LANDMARKS))]
    vehicles = [vehicle((1.5 * i, 0.0, 0.5), neighbours=names, initial_estimate=OFF) for i in range(3)]
    mixed, *alone = (run(start(scenario(vehicles, observer={"k": k})), 10)[-1] for k in (list(gains), *gains))
    for i, state in enumerate(alone):
        for name in ESTIMATE:
            assert_allclose(mixed[name][0, i], state[name][0, i], rtol=1e-9, atol=1e-12)
    assert np.abs(alone[0]["estimate_position"] - alone[2]["estimate_position"]).max() > 0.01


@pytest.mark.parametrize("k", [1.0, 6.0])
def test_a_target_of_twice_the_weight_counts_as_two_at_its_place(k: float) -> None:
    """A landmark, and a vehicle, whose marker is where its estimate has it."""
    marks, found = [landmark(f"L{i + 1}", place) for i, place in enumerate(LANDMARKS[:3])], []
    for twins, q in ((1, {"L1": 20.0, "vehicle_1": 20.0}), (2, 10.0)):
        leaders = [vehicle((-2.0 - 1e-3 * n, 1.0, 0.5), neighbours=["L2", "L3"]) for n in range(twins)]
        seen = ["L1", "L0", "vehicle_1", "vehicle_2"] if twins == 2 else ["L1", "vehicle_1"]
        vehicles = [{**made, "initial_estimate": OFF} for made in (*leaders, vehicle(neighbours=seen))]
        twin = [landmark("L0", LANDMARKS[0])] if twins == 2 else []
        world = start(scenario(vehicles, landmarks=[*marks, *twin], observer={"k": k, "q": q}))
        found.append({name: value[0, -1] for name, value in run(world, 5)[-1].items() if name in ESTIMATE})
    for name, value in found[0].items():
        assert_allclose(value, found[1][name], atol=5e-3)


@pytest.mark.parametrize("k", [1.0, 5.0])
def test_large_turns_are_relinearised(k: float) -> None:
    """From the paper's start, a quarter turn off: turns of 0.05 rad at most are nearly as good as of 0.01 rad."""
    described, found = from_oracle(replace(continuous.busy_intersection(), k=k), 60.0), []
    for most in (0.01, 0.05, 10.0):
        settings = described.observer.model_copy(update={"max_turn": most})
        state = run(start(described.model_copy(update={"observer": settings})), 10)[-1]
        found.append(np.concatenate([state[name].ravel() for name in ESTIMATE]))
    fine, usual, whole = found
    assert np.linalg.norm(usual - fine) < 0.2 * np.linalg.norm(whole - fine)


@pytest.mark.parametrize(("k", "q"), [(1.0, 10.0), (5.0, 10.0), (80.0, 25.0)])
def test_error_against_the_continuous_observer_falls_with_the_step(k: float, q: float) -> None:
    described = continuous.small_error_case(k, q, lever_arm=LEVER, angle=0.02, offset=0.05)
    reference = continuous.solve(described, 2.0, method="LSODA", sample=0.5)
    found = []
    for rate in (30, 120, 480):
        states = run(start(from_oracle(described, rate)), 2 * rate, *ESTIMATE)[:: rate // 2]
        truth = [described.pose(t)[1] for t in reference.t]
        position = [p - estimated_position(s)[0] for p, s in zip(truth, states, strict=True)]
        attitude = [s["estimate_rotation"][0] for s in states]
        covariance = [s["covariance"][0] for s in states]
        found.append(
            [
                np.abs(np.array(position) - reference.position_error).max(),
                np.abs(np.array(attitude) - reference.R_hat).max(),
                np.abs(np.array(covariance) - reference.P).max(),
            ]
        )
    coarse, middle, fine = np.array(found)
    assert (fine < [3e-4, 3e-4, 3e-3]).all()
    for rough, smooth in ((coarse, middle), (middle, fine)):
        assert ((smooth < 0.6 * rough) | (smooth < 1e-7)).all()


PAPER_SETTLES = (2.95, 7.90, 10.55, 11.65, 29.9)  # s, f1 .. f5


def test_busy_intersection_settles_like_the_continuous_observer() -> None:
    rate = 30.0
    overrides = {"noise.enabled": False, "rates.camera": rate}
    world = start(load_scenario("busy_intersection", overrides))
    ticks = round(50.0 * rate)
    states = run(world, ticks, *POSES)
    position, angle = (np.array(x)[:, 0] for x in zip(*(errors(world, s) for s in states), strict=True))
    settled = continuous.settle_times(np.arange(ticks + 1) / rate, np.eye(3)[0] * position[..., None], angle)
    solved = continuous.solve(continuous.busy_intersection(), 50.0)
    expected = continuous.settle_times(solved.t, solved.position_error, solved.angle_error_deg)
    assert_allclose(expected, PAPER_SETTLES, atol=0.051)
    assert (np.abs(settled - expected) <= np.maximum(0.1 * expected, 0.5)).all(), (settled, expected)
    assert position[-1].max() < 1e-6
    assert angle[-1].max() < 1e-5


def test_mirrored_start_ends_in_the_mirror() -> None:
    world = start(load_scenario("busy_intersection_mirror", {"noise.enabled": False}))
    world.advance(3000)
    assert world.get_state()["tick"][0] == 3000
    assert errors(world, world.get_state())[1].min() > 150.0


def test_float32_settles_too() -> None:
    world = start(load_scenario("busy_intersection", {"noise.enabled": False}), dtype="float32")
    world.advance(3000)
    position, angle = errors(world, world.get_state())
    assert position.max() < 1e-3
    assert angle.max() < 1e-2


def test_truth_is_an_equilibrium() -> None:
    made = continuous.small_error_case(5.0, lever_arm=LEVER)
    described = replace(made, position_hat=made.position, R_hat=made.R)
    world = start(from_oracle(described, 60.0))
    world.advance(600)
    position, angle = errors(world, world.get_state())
    assert position.max() < 1e-10
    assert angle.max() < 1e-8


def standing(**sections: object) -> World:
    return start(scenario([vehicle(initial_estimate=OFF)], **sections))


def test_slow_observer_corrects_at_its_own_rate_for_as_long() -> None:
    """At 20 Hz over 60 Hz frames: two ticks of prediction, then one correction over three ticks, as of 20 Hz frames."""
    world, V = standing(rates={"observer": 20.0}), np.diag([0.1] * 3 + [1.0] * 3)
    states = run(world, 6)
    assert_allclose(states[2]["covariance"][0, 0], states[0]["covariance"][0, 0] + 2 / 60 * V, rtol=1e-13)
    assert [int(s["corrected_tick"][0, 0]) for s in states] == [0, 0, 0, 3, 3, 3, 6]
    slow = run(standing(rates={"camera": 20.0, "decision": 20.0}), 2)
    for name in ESTIMATE:
        assert_allclose(states[3][name], slow[1][name], rtol=1e-9, atol=1e-12)
        assert_allclose(states[6][name], slow[2][name], rtol=1e-9, atol=1e-12)


def test_dead_reckoning_only_predicts() -> None:
    """Without noise of odometry the error stays, and so does the covariance of the position, P(0) here."""
    world = start(
        scenario(
            [vehicle(motion=constant([0.5, 0, 0], [0, 0, 0.3]), initial_estimate={"position_offset": [0.4, 0, 0]})],
            observer={"name": "dead_reckoning"},
        )
    )
    world.advance(600)
    state = world.get_state()
    position, angle = errors(world, state)
    assert_allclose(position, 0.4, atol=1e-10)
    assert angle.max() < 1e-10
    R, p, P = (state[name][0, 0] for name in ("estimate_rotation", "estimate_position", "covariance"))
    assert_allclose(position_covariance(R, R @ p, P), 100.0 * np.eye(3), rtol=1e-5, atol=1e-3)


@pytest.mark.parametrize("name", ["busy_intersection_tracking", "urban_crossing", "overtaking"])
def test_dead_reckoning_is_the_plug_in_of_that_name(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same estimates and the same covariance, by kernels on the paper's state and by NumPy in the map frame."""
    monkeypatch.setattr(registry, "_registered", {})
    registry.register("on_the_host", DeadReckoning)
    engines = []
    for observer in ("dead_reckoning", "on_the_host"):
        made = load_scenario(name, {"observer.name": observer})
        engine = Engine(made, dtype="float64")
        engine.reset([3])
        engine.step(ticks=90)
        engines.append(engine)
    embedded, plug_in = (
        {field: np.array(engine.view(field)[0]) for field in ("estimate_rotation", "estimate_position", "covariance")}
        for engine in engines
    )
    for field, values in embedded.items():
        assert_allclose(values, plug_in[field], rtol=1e-6, atol=1e-9)


def test_prediction_does_not_look_at_the_truth() -> None:
    """With nothing in range, a vehicle that is carried away unnoticed goes on as before."""
    world = standing(topology={"mode": "sensed"}, camera={"range": 1e-3})
    world.advance(3)
    saved = world.get_state()
    found = []
    for shift in (0.0, 5.0):
        moved = {**saved, "position": saved["position"] + shift * np.eye(5)[-1][:, None]}
        world.set_state(moved)
        world.advance(5)
        assert_allclose(world.get_state()["position"], moved["position"])
        found.append(world.get_state())
    for name in ("estimate_rotation", "estimate_position", "covariance"):
        assert same_bits(found[0][name], found[1][name])


# On the host


def embedded(scenario: Scenario, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    engine = Engine(scenario, 1, "float64")
    engine.reset([seed])
    rows = []
    for _ in range(scenario.horizon_ticks):
        engine.step(ticks=1)
        names = ("estimate_rotation", "estimate_position", "covariance", "nees")
        rows.append([engine.view(name)[0].copy() for name in names])
    return tuple(np.array(column) for column in zip(*rows, strict=True))  # type: ignore[return-value]


def test_the_plug_in_is_the_embedded_observer_with_camera_and_markers_off_centre() -> None:
    """Other cases are in tests/api/test_host_observers.py."""
    scenario = small_errors({"horizon": 2.0, "noise.bearing.scale": 0.003}, size=0.5)
    R, p, P, nees = embedded(scenario, 5)
    recording = record(scenario, 5)
    result = completed("riccati", recording)
    assert_allclose(result.rotation[1:], R, atol=1e-9)
    assert_allclose(result.position[1:], (R @ p[..., None])[..., 0], atol=1e-9)
    assert_allclose(result.covariance[1:], P, atol=1e-9)
    assert_allclose(result.nees[1:], nees, rtol=1e-6, atol=1e-9)
    assert (result.bytes_per_second == 24.0 / recording.dt / recording.period).all()


def test_hamel_samson_is_the_riccati_observer_without_neighbours() -> None:
    """Vehicle 1 sees landmarks only; for the others it must not change with what neighbours say."""
    recording = record(load_scenario("busy_intersection", {"horizon": 1.0}), 0)
    alone, together = run_observer("hamel_samson", recording), run_observer("riccati", recording)
    assert_allclose(alone.position[:, 0], together.position[:, 0], rtol=0, atol=1e-12)
    assert np.abs(alone.position[-1, 1:] - together.position[-1, 1:]).max(axis=1).min() > 0.01


NOISE = {
    "velocity": 0.05,
    "angular_velocity": 0.02,
    "bearing": {"model": "isotropic", "scale": 0.01},
}
MIXED_ERRORS = (
    {"position_radius": 0.5, "orientation_angle": 0.2},
    {"position_radius": 10.0, "orientation_angle": "uniform"},
    {"position_offset": [30.0, -20.0, 10.0], "orientation_offset_wxyz": [0.0, 0.0, 0.0, 1.0]},
)


def circling(miss: float = 0.5, **observer: object) -> Scenario:
    """Return three vehicles on circles that lose detections and messages at random."""
    vehicles = [
        vehicle(
            (1.5 * i, -1.0 * i, 0.5),
            yaw=0.7 * i,
            motion=constant([0.4, 0.0, 0.0], [0.0, 0.0, 0.2 + 0.1 * i]),
            initial_estimate=error,
        )
        for i, error in enumerate(MIXED_ERRORS)
    ]
    return scenario(
        vehicles,
        noise=NOISE,
        camera={"orientation": "body", "miss_probability": miss, "position": [0.3, 0.0, 0.2]},
        v2x={"delay": 1, "loss": 0.3},
        observer={"q": 25.0, **observer},
    )


def assert_healthy(world: World) -> None:
    state = world.get_state()
    P, R, p = state["covariance"], state["estimate_rotation"], state["estimate_position"]
    assert np.isfinite(P).all()
    assert (np.swapaxes(P, -1, -2) == P).all()
    P = P.astype(float)
    diagonal = np.sqrt(np.diagonal(P, axis1=-2, axis2=-1))
    assert np.isfinite(diagonal).all()
    assert (diagonal > 0.0).all()
    correlation = P / (diagonal[..., :, None] * diagonal[..., None, :])
    assert np.linalg.eigvalsh(correlation).min() > 0.0
    assert np.isfinite(p).all()
    R = R.astype(float)
    slack = 1e-12 if world.precision.name == "float64" else 3e-6
    assert np.abs(np.swapaxes(R, -1, -2) @ R - np.eye(3)).max() < slack
    assert np.linalg.det(R).min() > 0.5


def watch(world: World, ticks: int, every: int) -> None:
    for _ in range(ticks // every):
        world.advance(every)
        assert_healthy(world)
    assert (world.get_state()["tick"] == ticks // every * every).all()


def alone(origin: np.ndarray, landmarks: int, k: float) -> Scenario:
    """Return one vehicle near an origin with some landmarks."""
    motion = constant([0.4, 0.0, 0.0], [0.0, 0.0, 0.3])
    return scenario(
        [vehicle(origin, motion=motion, initial_estimate=MIXED_ERRORS[0])],
        landmarks=[landmark(f"L{i}", (origin + p).tolist()) for i, p in enumerate(LANDMARKS[:landmarks])],
        noise=NOISE,
        observer={"k": k, "q": 25.0},
    )


FAR = np.array([1000.0, -500.0, 0.0])
RUNS: dict[str, tuple[Scenario, int, int]] = {
    "stiff": (circling(k=80.0), 6000, 60),
    **{f"almost never a target in view, k={k}": (circling(miss=0.999, k=k), 6000, 30) for k in (1.0, 80.0)},
    **{f"one landmark, k={k}": (alone(np.zeros(3), 1, k), 3000, 20) for k in (1.0, 80.0)},
    **{f"P0={P0}": (circling(k=80.0, P0=P0), 300, 1) for P0 in ([1e-6, 1e-6], [1e3, 1e5], [1e-6, 1e4])},
    "1 km from the origin, condition number of M above 1e12": (alone(FAR, len(LANDMARKS), 80.0), 1800, 10),
}


@pytest.mark.parametrize(("name", "dtype"), [*((name, "float32") for name in RUNS), ("stiff", "float64")])
def test_estimates_stay_healthy(name: str, dtype: str) -> None:
    made, ticks, every = RUNS[name]
    watch(start(made, range(4), dtype), ticks, every)


@pytest.mark.parametrize("k", [0.6, 1.0, 80.0, 1000.0])
def test_any_gain_over_a_minute_tick_by_tick(k: float) -> None:
    world = start(circling(k=k), range(4), "float32")
    watch(world, 600, 1)
    for _ in range(25):
        world.advance(60)
        assert_healthy(world)


@pytest.mark.parametrize("k", [1.0, 80.0])
def test_nothing_in_view_then_everything(k: float) -> None:
    """Five minutes blind, then every target at once."""
    world = start(circling(miss=1.0, k=k), range(4), "float32")
    watch(world, 18000, 6000)
    growth = 300.0 * np.array([0.1] * 3 + [1.0] * 3)
    P = world.get_state()["covariance"]
    np.testing.assert_allclose(
        np.diagonal(P, axis1=-2, axis2=-1), np.broadcast_to([1.0] * 3 + [100.0] * 3 + growth, (4, 3, 6)), rtol=2e-3
    )
    seeing = start(circling(miss=0.0, k=k), range(4), "float32")
    seeing.set_state(world.get_state())
    for _ in range(300):
        seeing.advance(1)
        assert_healthy(seeing)
