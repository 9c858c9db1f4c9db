"""Latency, correlated errors and a walking mounting of cameras, and the accuracy of maps."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

import coopenv
from coopenv.base.errors import ScenarioError, ScenarioWarning
from coopenv.observers.contract import Estimate, Message, Setup, Tick
from coopenv.observers.setups import observer_init_of
from coopenv.runs import record
from coopenv.scenario import Scenario, parse_scenario
from coopenv.sources.mcap import read_recording, write_recording
from coopenv.sources.worlds import Replay, SimulatedWorld
from tests.helpers.builders import (
    assert_same,
    circling,
    command,
    constant,
    landmark,
    raw,
    reset,
    run,
    same_bits,
    scenario,
    start,
    vehicle,
)

WORLDS = 400
LATE = {"latency": 0.03, "latency_error": 0.005, "latency_jitter": 0.002}
ALL = {
    "camera": {"orientation": "body", "extrinsics_walk": 0.01, **LATE},
    "noise": {"velocity": 0.1, "bearing": {"scale": 0.003, "correlated": {"std": 0.004, "time": 0.5}}},
    "map": {"accuracy": 0.05},
}


def body(**more: Any) -> dict[str, Any]:
    return {"orientation": "body", **more}


def bearings_of(description: Scenario, ticks: int, actions: Any = None) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return the bearings (K, N, A, 3) of a world and the truth of all agents at its ticks."""
    world = start(description)
    if actions is not None:
        command(world, actions)
    states = run(world, ticks, "bearing", "position", "rotation")
    truth = {name: np.array([state[name][0] for state in states]) for name in ("position", "rotation")}
    return np.array([state["bearing"][0] for state in states]), truth


def test_a_late_frame_shows_what_a_prompt_one_showed_then() -> None:
    """At constant twists it does so exactly: three ticks of 10 ms, with a lever arm and a landmark that moves."""
    vehicles = [
        vehicle(motion=constant([8.0, 0.5, 0.0], [0.0, 0.1, 0.7]), marker=[0.2, 0.1, 0.4]),
        vehicle((4.0, -3.0, 0.5), 0.5, motion=constant([-3.0, 0.0, 0.0], [0.0, 0.0, -0.5])),
    ]
    marks = [landmark("L1", (3.0, 9.0, 2.0)), landmark("L2", (-3.0, 5.0, 1.0), motion=constant([2.0, 0.0, 0.0]))]
    given = {"landmarks": marks, "rates": {"camera": 100.0}, "topology": {"acyclic": False}}
    camera = body(position=[0.5, 0.0, 0.3])
    prompt, _ = bearings_of(scenario(vehicles, camera=camera, **given), 40)
    late, _ = bearings_of(scenario(vehicles, camera=camera | {"latency": 0.03}, **given), 40)
    assert_allclose(late[3:], prompt[:-3], atol=1e-12)
    assert np.abs(late - prompt).max() > 0.01


def test_a_late_frame_of_a_car_that_speeds_up_steers_and_pans() -> None:
    """The oracle interpolates the truth; what remains is the change of the twist within the latency."""
    latency, acceleration, distance = 0.03, 2.0, 2.0
    vehicles = [vehicle(motion={"kind": "driven", "initial_speed": 1.0}), vehicle((4.0, -3.0, 0.5))]
    pan = {"limit": 1.2, "rate": 0.9}
    made = scenario(vehicles, camera=body(latency=latency), action={"pan": pan}, dynamics={"max_speed": 8.0})
    late, truth = bearings_of(made, 60, [0.5, 0.8, 1.0])
    t, agent = np.arange(61) / 60.0, 4
    then = t[2:] - latency
    R = RotationSpline(t, Rotation.from_matrix(truth["rotation"][:, agent]))(then).as_matrix()
    own = CubicSpline(t, truth["position"][:, agent])(then)
    for target in range(4):
        line = np.einsum("kji,kj->ki", R, truth["position"][2:, target] - own)
        expected = line / np.linalg.norm(line, axis=-1, keepdims=True)
        assert_allclose(late[2:, 0, target], expected, atol=1.5 * acceleration * latency**2 / 2.0 / distance)
    assert np.linalg.norm(own[-1] - own[0]) > 1.0
    whole, prompt = (
        bearings_of(
            made.model_copy(update={"camera": made.camera.model_copy(update={"latency": age})}), 60, [0.5, 0.8, 1.0]
        )
        for age in (2.0 / 60.0, 0.0)
    )
    assert_allclose(whole[0][2:], prompt[0][:-2], atol=1e-12)


def test_observers_of_ones_own_have_the_age_and_infos_the_delay() -> None:
    ticks: list[Tick] = []

    class Still:
        def __init__(self, setup: Setup) -> None:
            pass

        def reset(self, initial_pose: tuple[np.ndarray, np.ndarray], initial_covariance: np.ndarray) -> None:
            self.estimate = Estimate(*initial_pose)

        def update(self, tick: Tick) -> Estimate:
            ticks.append(tick)
            return self.estimate

        def message(self) -> Message:
            return Message(position=self.estimate.position)

    made = scenario([vehicle(), vehicle((1.0, 0.0, 0.5), camera={"latency": 0.01})], **ALL)
    env = coopenv.parallel_env(made, observer=Still, dtype="float64")
    _, infos = env.reset(seed=1)
    env.step({agent: np.zeros(2) for agent in env.agents})
    assert [tick.bearing_age for tick in ticks[:2]] == [0.03, 0.01]
    assert infos["vehicle_1"]["truth"]["camera_delay"] == env.engine.view("camera_delay")[0, 0] != 0.0
    assert np.abs(ticks[0].landmarks - env.engine.view("position")[0, :4]).min() > 0.0


def ages(states: list[dict[str, np.ndarray]], speed: float, aside: tuple[float, ...]) -> np.ndarray:
    """Return the ages (K, W, L) of frames by the bearings of a vehicle that passes landmarks at x = 0 along x."""
    b = np.array([state["bearing"][:, 0, : len(aside)] for state in states])
    x = np.array([state["position"][:, -2:-1, 0] for state in states])
    return np.asarray((x + np.array(aside) * b[..., 0] / b[..., 1]) / speed)


def test_latency_has_a_constant_error_of_each_vehicle_and_a_jitter_of_each_frame() -> None:
    speed, aside, ticks = 20.0, (5.0, 8.0, -6.0), 50
    marks = [landmark(f"L{i}", (0.0, y, 0.5)) for i, y in enumerate(aside)]
    moving = {"motion": constant([speed, 0.0, 0.0])}
    vehicles = [vehicle((-8.0, 0.0, 0.5), **moving), vehicle((-8.0, 1.0, 0.5), **moving)]
    made = scenario(vehicles, landmarks=marks, camera=body(**LATE))
    world = start(made, range(WORLDS))
    states = run(world, ticks, "bearing", "position", "camera_delay", "bearing_age")
    found = ages(states, speed, aside)
    assert_allclose(found, found[..., :1].repeat(3, axis=-1), atol=1e-9)  # one age of a frame
    delay = states[-1]["camera_delay"]
    jitter = found[..., 0] - 0.03 - delay[:, 0]
    assert np.std(jitter) == pytest.approx(0.002, rel=4.0 / np.sqrt(2.0 * jitter.size))
    assert abs(np.mean(jitter[1:] * jitter[:-1])) < 4.0 * 0.002**2 / np.sqrt(jitter.size)
    assert np.std(delay) == pytest.approx(0.005, rel=4.0 / np.sqrt(2.0 * delay.size))
    assert abs(np.corrcoef(delay.T)[0, 1]) < 4.0 / np.sqrt(WORLDS)
    assert_allclose(states[-1]["bearing_age"], 0.03)
    noise = observer_init_of(made, world.model).setups[0].noise
    assert (noise.latency, noise.latency_jitter) == (0.005, 0.002)


def test_a_mounting_walks_with_the_square_root_of_time() -> None:
    walk, ticks = 0.01, 120
    made = scenario(camera=body(extrinsics_walk=walk, extrinsics_error=0.02))
    states = run(start(made, range(WORLDS)), ticks, "camera_turn", "bearing", "position")
    turn = np.array([state["camera_turn"][:, 0] for state in states])
    assert np.std(turn[0]) == pytest.approx(0.02, rel=4.0 / np.sqrt(6.0 * WORLDS))
    for k in (30, 120):
        grown = turn[k] - turn[0]
        assert np.std(grown) == pytest.approx(walk * np.sqrt(k / 60.0), rel=4.0 / np.sqrt(6.0 * WORLDS))
    steps = np.diff(turn, axis=0)
    assert abs(np.mean(steps[1:] * steps[:-1])) < 4.0 * walk**2 / 60.0 / np.sqrt(steps.size)
    line = states[-1]["position"][:, :4] - states[-1]["position"][:, 4:]
    seen = Rotation.from_rotvec(turn[-1]).inv().as_matrix()[:, None] @ line[..., None]
    seen = seen[..., 0] / np.linalg.norm(line, axis=-1, keepdims=True)
    assert_allclose(states[-1]["bearing"][:, 0, :4], seen, atol=1e-12)


STD, TIME, WHITE = 0.004, 0.25, 0.002
SLOW = {"scale": 0.0, "correlated": {"std": STD, "time": TIME}}


def errors(noise: dict[str, Any], ticks: int) -> np.ndarray:
    """Return the errors (K, W, N, L, 3) of bearings of two standing vehicles to four landmarks."""
    made = scenario([vehicle(), vehicle((1.0, 0.0, 0.5))], noise={"bearing": noise}, camera=body())
    exact = start(scenario([vehicle(), vehicle((1.0, 0.0, 0.5))], camera=body())).view("bearing")[:, :, :4]
    states = run(start(made, range(WORLDS)), ticks, "bearing")
    return np.array([state["bearing"][:, :, :4] - exact for state in states])


def test_correlated_errors_are_a_gauss_markov_process_of_every_target() -> None:
    e = errors(SLOW, 60)
    power = np.sum(e**2, axis=-1)
    count = 2.0 * WORLDS * 8
    for k in (0, 1, 60):
        assert np.mean(power[k]) / 2.0 == pytest.approx(STD**2, rel=4.0 * np.sqrt(2.0 / count)), k
    for lag in (1, 6, 15, 60):
        share = np.mean(np.sum(e[0] * e[lag], axis=-1)) / 2.0 / STD**2
        assert share == pytest.approx(np.exp(-lag / 60.0 / TIME), abs=4.0 / np.sqrt(count)), lag
    across = e[0].reshape(WORLDS, 8, 3)
    for i, j in ((0, 1), (0, 4), (2, 7)):
        assert abs(np.mean(across[:, i] * across[:, j])) < 4.0 * STD**2 / np.sqrt(2.0 * WORLDS)


def test_correlated_errors_count_as_white_noise_with_their_long_mean() -> None:
    """The stated deviation over the square root of the number of frames is that of a mean over many times."""
    noise = {"scale": WHITE, "correlated": {"std": STD, "time": 0.05}}
    made = scenario([vehicle(), vehicle((1.0, 0.0, 0.5))], noise={"bearing": noise}, camera=body())
    stated = observer_init_of(made, start(made).model).setups[0].noise.bearing
    mean = np.mean(errors(noise, 239), axis=0)
    found = np.sqrt(np.mean(np.sum(mean**2, axis=-1)) / 2.0 * 240)
    # the ends of the mean take a share of about two times the correlation time off
    assert stated == pytest.approx(found, rel=0.05 + 2.0 / np.sqrt(2.0 * WORLDS * 8))
    assert stated > 2.0 * np.hypot(WHITE, STD)


def test_the_error_is_carried_over_frames_without_the_target() -> None:
    """With misses, the correlation is that of the time between two bearings."""
    made = scenario(camera=body(miss_probability=0.6), noise={"bearing": SLOW}, topology={"mode": "sensed"})
    exact = start(scenario(camera=body())).view("bearing")[0, 0, :4]
    states = run(start(made, range(WORLDS)), 60, "bearing", "bearing_tick")
    first = np.array([s["bearing"][:, 0, :4] for s in states])
    tick = np.array([s["bearing_tick"][:, 0, :4] for s in states])
    now, before = (tick[30:] == np.arange(30, 61)[:, None, None]) & (tick[24:-6] >= 0), first[24:-6] - exact
    elapsed = (tick[30:] - tick[24:-6])[now] / 60.0
    product = np.sum((first[30:] - exact) * before, axis=-1)[now] / 2.0 / STD**2
    expected = np.exp(-elapsed / TIME)
    assert np.mean(product) == pytest.approx(np.mean(expected), abs=0.03)
    assert elapsed.max() > 0.15


def landmarks_known(world: SimulatedWorld) -> np.ndarray:
    """Return the positions (W, L, 3) that observers know."""
    return np.array([world.sensed(w, 0).landmarks for w in range(world.worlds)])


def test_maps_are_off_by_their_accuracy() -> None:
    marks = raw()["landmarks"]
    marks[1]["accuracy"], marks[3]["accuracy"] = 0.0, 0.2
    made, exact = (scenario(circling(), landmarks=marks, map={"accuracy": a}) for a in (0.05, 0.0))
    world, other = start(made, range(WORLDS)), start(exact, range(WORLDS))
    assert isinstance(world, SimulatedWorld)
    assert same_bits(world.view("position"), other.view("position"))
    assert same_bits(world.view("bearing"), other.view("bearing"))
    off = landmarks_known(world) - world.view("position")[:, :4]
    for n, std in enumerate((0.05, 0.0, 0.05, 0.2)):
        assert np.std(off[:, n]) == pytest.approx(std, rel=4.0 / np.sqrt(6.0 * WORLDS))
        assert abs(np.mean(off[:, n])) <= 4.0 * std / np.sqrt(3.0 * WORLDS)
    assert abs(np.mean(off[:, 0] * off[:, 2])) < 4.0 * 0.05**2 / np.sqrt(3.0 * WORLDS)
    setups = observer_init_of(made, world.model).setups
    assert setups[2].landmark_std == (0.05, 0.0, 0.05, 0.2)
    known = [world.sensed(1, 0).tick(setup, {}).landmarks for setup in setups]
    assert_array_equal(known[0], known[2])
    world.advance(60)
    assert_allclose(landmarks_known(world) - world.view("position")[:, :4], off, atol=1e-12)
    assert observer_init_of(scenario(), start(scenario()).model).setups[0].landmark_std == ()


def test_resets_draw_anew_and_batches_are_single_worlds() -> None:
    made = scenario(circling(), **ALL)
    world, alone = start(made, [4, 5]), start(made, [5])
    drawn = ("camera_delay", "map_offset", "bearing_drift")
    first = world.get_state()
    for each in (world, alone):
        each.advance(30)
    assert_same(world.get_state(), alone.get_state(), slice(1, 2))
    saved = world.get_state()
    world.advance(30)
    after = world.get_state()
    world.set_state(saved)
    world.advance(30)
    assert_same(world.get_state(), after)
    reset(world)
    second = world.get_state()
    reset(world, [4, 5])
    assert_same(world.get_state(), first)
    for name in drawn:
        assert np.any(first[name]) and not np.any(first[name] == second[name], where=first[name] != 0.0), name


def test_recordings_logs_and_replays_keep_the_age_and_the_map(tmp_path: Path) -> None:
    made = scenario(circling(camera={"latency": 0.04}), horizon=0.5, **ALL)
    recording = record(made, 3)
    write_recording(recording, tmp_path / "log.mcap")
    read = read_recording(tmp_path / "log.mcap")
    assert_allclose(read.bearing_age, 0.04)
    for name in ("bearings", "landmarks", "bearing_age"):
        assert_array_equal(getattr(read, name), getattr(recording, name))
    assert read.setups[1].landmark_std == recording.setups[1].landmark_std == (0.05,) * 4
    assert read.setups[1].noise == recording.setups[1].noise
    assert recording.tick(7, 1, {}).bearing_age == 0.04
    replayed, world = Replay(read, "test").world(1, "float64", "cpu", 1), start(made, 3)
    replayed.reset([0])
    for each in (replayed, world):
        each.advance(30)
    a, b = replayed.get_state(), world.get_state()
    assert_array_equal(a["bearing_tick"], b["bearing_tick"])
    for name in ("bearing_age", "bearing", "estimate_position", "estimate_rotation"):
        assert_allclose(a[name], b[name], atol=1e-9, err_msg=name)
    off = np.linalg.norm(recording.landmarks[0] - world.view("position")[0, :4], axis=-1)
    assert (off > 0.005).all()


def test_the_switch_of_noise_leaves_the_known_latency_alone() -> None:
    noise = {**ALL["noise"], "enabled": False}
    made = scenario(circling(), **{**ALL, "noise": noise})
    plain = scenario(circling(), camera=body(latency=0.03))
    states = [start(each, 1) for each in (made, plain)]
    for world in states:
        world.advance(10)
    assert same_bits(states[0].view("bearing"), states[1].view("bearing"))
    setup = observer_init_of(made, states[0].model).setups[0]
    assert setup.landmark_std == () and setup.noise.latency == setup.noise.bearing == 0.0
    assert states[0].sensed(0, 10).tick(setup, {}).bearing_age == 0.03  # type: ignore[attr-defined]


def test_observers_that_ignore_them_are_named() -> None:
    with pytest.warns(ScenarioWarning, match="'riccati' .* ignores camera.latency, map.accuracy"):
        parse_scenario(raw(circling(), **ALL), "test")


@pytest.mark.parametrize(
    ("sections", "message"),
    [
        ({"camera": {"latency": -0.1}}, "camera.latency"),
        ({"camera": {"latency": 30.0}}, "camera.latency: .* less than or equal to 5, got 30.*: milliseconds in place"),
        ({"camera": {"latency_std": 0.1}}, "camera.latency_std"),
        ({"noise": {"bearing": {"correlated": {"std": 0.1, "time": 0.0}}}}, "noise.bearing.correlated.time"),
        ({"map": {"accuracy": -1.0}}, "map.accuracy"),
    ],
)
def test_wrong_keys_are_named_in_one_line(sections: dict[str, Any], message: str) -> None:
    with pytest.raises(ScenarioError, match=message) as error:
        scenario(**sections)
    assert "\n" not in str(error.value)
