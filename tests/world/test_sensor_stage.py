"""Sensors beside the camera in simulated worlds: which targets are measured, and the values with their errors."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from coopenv.api.engine import Engine
from coopenv.api.terms.layout import observation_layout
from coopenv.base.errors import CoopenvError, ScenarioError
from coopenv.measurements.kinds import Kind, Placed
from coopenv.measurements.sensor import kept_kind
from coopenv.measurements.table import KINDS
from coopenv.scenario import Scenario
from coopenv.sources.worlds import Simulated, SimulatedWorld
from tests.helpers.builders import constant, landmark, run, same_bits, scenario, start, vehicle
from tests.helpers.warp_calls import DTYPES

DOPPLER = "tests.helpers.doppler:Doppler"
EXACT = {"enabled": False}
MOUNTING = {"position": [0.3, -0.1, 0.2], "orientation": [0.6, 0.0, 0.8, 0.0]}
TOLERANCE = {"float64": 1e-9, "float32": 1e-4}


def sensing(*sensors: dict[str, Any], vehicles: Any = None, **sections: Any) -> Scenario:
    """Return a scenario with sensors: by default two vehicles on circles, each a neighbour of the other."""
    motions = (constant([0.3, 0.0, 0.0], [0.0, 0.0, 0.2]), constant([0.5, 0.0, 0.1], [0.1, 0.0, 0.3]))
    moving = [vehicle((2.0 * i, -1.0, 0.5), motion=motion, marker=[0.1, 0.2, 0.3]) for i, motion in enumerate(motions)]
    sections.setdefault("topology", {"acyclic": False})
    return scenario(moving if vehicles is None else vehicles, sensors=list(sensors), **sections)


def world_of(description: Scenario, seeds: Any = 0, dtype: str = "float64") -> SimulatedWorld:
    world = start(description, seeds, dtype)
    assert isinstance(world, SimulatedWorld)
    return world


def places(world: SimulatedWorld, i: int, target: int, sensor: dict[str, Any]) -> tuple[Placed, Placed]:
    """Return where a sensor of vehicle i is, and a target, by the truth; independent of `Sensor.placed`."""
    L = world.model.landmarks
    state = {name: world.view(name)[0].astype(float) for name in ("rotation", "position", "velocity")}
    turning = world.view("angular_velocity")[0].astype(float)
    w, x, y, z = sensor["orientation"]
    mounted = np.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
            [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )

    def moved(agent: int, point: Any, turn: np.ndarray) -> Placed:
        R = state["rotation"][agent]
        velocity = R @ (state["velocity"][agent] + np.cross(turning[agent], point))
        return Placed(state["position"][agent] + R @ point, R @ turn, velocity, turn.T @ turning[agent])

    marker = world.scenario.vehicles[target - L].marker if target >= L else (0.0, 0.0, 0.0)
    return moved(L + i, sensor["position"], mounted), moved(target, marker, np.eye(3))


@pytest.mark.parametrize("kind", [*KINDS, DOPPLER, f"{DOPPLER}InWarp"])
@pytest.mark.parametrize("dtype", DTYPES)
def test_a_sensor_without_noise_measures_what_its_kind_predicts(kind: str, dtype: str) -> None:
    sensor = {"kind": kind, "name": "own", "towards": ["landmarks", "vehicles"], **MOUNTING}
    made: Kind = kept_kind(kind, json.dumps({}))
    world = world_of(sensing(sensor, noise=EXACT), dtype=dtype)
    for tick in range(0, 90, 30):
        readings = world.sensed(0, tick).readings["own"]
        for i in range(2):
            for target in [n for n in range(6) if n != 4 + i] if made.has_target else [0]:
                own, there = places(world, i, target, sensor)
                difference = made.residual(readings[i, target], made.predict(own, there))
                assert_allclose(difference, 0.0, atol=TOLERANCE[dtype], err_msg=f"{tick} {i} {target}")
        world.advance(30)


def values_of(description: Scenario, worlds: int, ticks: int) -> np.ndarray:
    """Return the errors (ticks + 1, worlds, size) of the first sensor of a standing vehicle; NaN: not measured."""
    world = world_of(description, range(worlds))
    states = run(world, ticks, "reading", "reading_tick", "position")
    size = description.sensors[0].made.size
    fresh = np.stack([s["reading_tick"][:, 0, 0, 0] == k for k, s in enumerate(states)])
    values = np.stack([s["reading"][:, 0, 0, 0, :size] - s["position"][:, -1] for s in states])
    return np.where(fresh[..., None], values, np.nan)


def standing(**sensor: Any) -> Scenario:
    """Return a scenario of a standing vehicle with a receiver of positions."""
    return sensing({"kind": "position", **sensor}, vehicles=[vehicle()])


def test_white_noise_has_its_standard_deviations_and_no_memory() -> None:
    errors = values_of(standing(noise=[0.1, 0.2, 0.4]), 60, 50)
    assert_allclose(errors.std(axis=(0, 1)), [0.1, 0.2, 0.4], rtol=0.05)
    assert np.abs((errors[1:] * errors[:-1]).mean(axis=(0, 1)) / errors.var(axis=(0, 1))).max() < 0.06


def test_a_bias_lasts_an_episode_and_differs_between_vehicles_and_episodes() -> None:
    errors = values_of(standing(noise=1e-6, bias=0.5), 900, 2)
    assert_allclose(errors, errors[:1].repeat(3, axis=0), atol=1e-4)
    assert_allclose(errors[0].std(axis=0), 0.5, rtol=0.08)
    assert np.abs(np.corrcoef(errors[0].T) - np.eye(3)).max() < 0.12


def test_a_correlated_error_has_its_size_and_correlation_time() -> None:
    description = standing(noise=1e-6, correlated={"std": 0.5, "time": 0.1})
    errors = values_of(description, 150, 40)
    expected = np.exp(-np.arange(1, 4) / (description.rates.camera * 0.1))
    found = [(errors[n:] * errors[:-n]).mean() / errors.var() for n in (1, 2, 3)]
    assert_allclose(errors.std(axis=(1, 2)), 0.5, rtol=0.2)  # from the first tick on
    assert_allclose(found, expected, atol=0.03)


def test_outages_cover_their_share_of_time_and_last_as_long_as_stated() -> None:
    description = standing(outages={"rate": 2.0, "duration": 0.25})
    out = np.isnan(values_of(description, 200, 120)[..., 0])
    assert_allclose(out.mean(), 2.0 / (2.0 + 1.0 / 0.25), atol=0.03)
    ends = (out[:-1] & ~out[1:]).sum() / out[:-1].sum()
    share, kept = 1.0 / 3.0, np.exp(-6.0 / description.rates.camera)
    assert_allclose(ends, 1.0 - (share + (1.0 - share) * kept), rtol=0.08)


def test_misses_and_outliers_have_their_shares() -> None:
    sensor = {"miss_probability": 0.3, "outliers": {"probability": 0.2, "size": 4.0}}
    errors = values_of(standing(noise=1e-6, **sensor), 600, 60)
    missed = np.isnan(errors[..., 0])
    assert_allclose(missed.mean(), 0.3, atol=0.02)
    found = errors[~missed]
    wrong = found[:, 0] > 1e-3
    assert_allclose(wrong.mean(), 0.2, atol=0.02)
    assert_allclose(found[wrong].mean(), 4.0, rtol=0.1)
    assert_allclose(found[wrong].std(), 4.0, rtol=0.1)
    assert_allclose(found, found[:, :1].repeat(3, axis=1), atol=1e-4)  # one error in all rows
    assert found.min() > -1e-4


@pytest.mark.parametrize("rate", [None, 60.0, 25.0, 7.0, 1.0, 600.0])
def test_measurements_fall_on_the_ticks_nearest_to_their_times(rate: float | None) -> None:
    made = ~np.isnan(values_of(standing(rate=rate), 1, 130)[:, 0, 0])
    times = np.arange(0, 200) / min(rate or 60.0, 60.0)
    expected = np.floor(times * 60.0 + 0.5 + 1e-6).astype(int)
    assert_array_equal(np.flatnonzero(made), np.unique(expected[expected <= 130]))


def measured(description: Scenario, name: str = "range") -> np.ndarray:
    """Return which targets (N, T) are measured at the start."""
    return np.isfinite(world_of(description).sensed(0, 0).readings[name]).all(axis=-1)


MARKS = [
    landmark("near", (2.0, 0.0, 0.5)),
    landmark("far", (9.0, 0.0, 0.5)),
    landmark("left", (0.0, 3.0, 0.5)),
    landmark("radio", (0.0, -3.0, 0.5), anchor=True),
]
WALL = {"name": "wall", "center": [5.0, 0.0, 1.0], "size": [0.2, 2.0, 4.0]}


@pytest.mark.parametrize(
    ("sensor", "expected"),
    [
        ({"towards": ["landmarks"]}, ["near", "left"]),
        ({"towards": ["anchors"]}, ["radio"]),
        ({"towards": ["landmarks"], "occluded": False}, ["near", "far", "left"]),
        ({"towards": ["far", "radio"], "occluded": False}, ["far", "radio"]),
        ({"towards": ["landmarks", "anchors"], "range": 2.5}, ["near"]),
        ({"towards": ["landmarks", "anchors"], "field_of_view": 3.0}, ["near"]),
        ({"towards": ["landmarks", "anchors"], "field_of_view": 3.3}, ["near", "left", "radio"]),
        ({"towards": ["left"], "field_of_view": 0.2, "orientation": [2**-0.5, 0.0, 0.0, 2**-0.5]}, ["left"]),
        ({"towards": ["landmarks"], "miss_probability": 1.0}, []),
        ({"vehicles": ["vehicle_2"]}, []),
    ],
)
@pytest.mark.parametrize("mode", ["fixed", "sensed"])
def test_a_target_is_measured_as_the_keys_of_the_sensor_say(
    mode: str, sensor: dict[str, Any], expected: list[str]
) -> None:
    cars = [vehicle(), vehicle((-50.0, 0.0, 0.5), neighbours=[])]
    topology = {"mode": mode}
    description = sensing(
        {"kind": "range", **sensor}, vehicles=cars, landmarks=MARKS, obstacles=[WALL], topology=topology
    )
    assert [description.target_names[n] for n in np.flatnonzero(measured(description)[0])] == expected


def test_cameras_see_neither_anchors_nor_anything_without_a_camera() -> None:
    for camera, seen in (({}, [True, True, True, False, False]), ({"model": "none"}, [False] * 5)):
        world = world_of(sensing(vehicles=[vehicle()], landmarks=MARKS, camera=camera))
        assert_array_equal(world.sensed(0, 0).visible[0], seen)


def test_maps_expect_neither_anchors_nor_anything_without_a_camera() -> None:
    for camera, seen in (({}, 3), ({"model": "none"}, 0)):
        description = sensing(
            vehicles=[vehicle()], landmarks=MARKS, camera=camera, observation={"include": ["map"], "map_size": 4}
        )
        engine = Engine(description, 1, "float64")
        engine.reset([0])
        field = observation_layout(description)["map_in_view"]
        assert field.values(engine.view("observation")[0, 0]).sum() == seen


def test_ideal_sensing_measures_everything_and_blind_sensing_nothing() -> None:
    sensor = {
        "kind": "range",
        "towards": ["landmarks"],
        "range": 1.0,
        "miss_probability": 0.9,
        "outages": {"rate": 1e6, "duration": 1e6},
    }
    for mode, count in (("ideal", 3), ("blind", 0), ("sensed", 0)):
        description = sensing(sensor, vehicles=[vehicle()], landmarks=MARKS, obstacles=[WALL], sensing=mode)
        assert measured(description).sum() == count


def test_a_building_above_hides_the_sky_from_a_receiver_alone() -> None:
    bridge = {"name": "bridge", "center": [0.0, 0.0, 6.0], "size": [8.0, 8.0, 1.0]}
    sensors = [{"kind": "position"}, {"kind": "position", "name": "through", "occluded": False}, {"kind": "attitude"}]
    world = world_of(sensing(*sensors, vehicles=[vehicle()], obstacles=[bridge]))
    found = {name: bool(np.isfinite(values).all()) for name, values in world.sensed(0, 0).readings.items()}
    assert found == {"position": False, "through": True, "attitude": True}


OF_SENSORS = ("reading", "sensor_", "information", "gramian")
"""Beginnings of the names of the state's fields that sensors write, or that hold their information."""


def test_draws_of_worlds_stay_bit_for_bit_with_and_without_sensors() -> None:
    sensors = [{"kind": kind} for kind in KINDS]
    with_them, without = (world_of(sensing(*found), range(2)) for found in (sensors, []))
    for _ in range(3):
        expected = without.get_state()
        for name, values in with_them.get_state().items():
            if not name.startswith(OF_SENSORS):
                assert same_bits(values, expected[name]), name
        for world in (with_them, without):
            world.advance(6)


def test_a_batch_measures_bit_for_bit_what_single_worlds_measure() -> None:
    errors = {"bias": 0.1, "correlated": {"std": 0.2}, "outages": {"rate": 1.0, "duration": 0.2}}
    description = sensing({"kind": "range", "towards": ["landmarks", "vehicles"], **errors}, {"kind": DOPPLER})
    batch, single = world_of(description, [4, 7, 9]), world_of(description, 7)
    for tick in range(0, 24, 6):
        for name, values in batch.sensed(1, tick).readings.items():
            assert same_bits(values, single.sensed(0, tick).readings[name]), (tick, name)
        batch.advance(6)
        single.advance(6)


def test_a_saved_state_continues_bit_for_bit() -> None:
    errors = {"correlated": {"std": 0.2}, "outages": {"rate": 5.0, "duration": 0.2}}
    description = sensing({"kind": "position", **errors}, {"kind": DOPPLER})
    world = world_of(description)
    world.advance(6)
    saved = world.get_state()
    world.advance(6)
    expected = world.sensed(0, 12).readings
    again = world_of(description, 1)
    again.set_state(saved)
    again.advance(6)
    for name, values in again.sensed(0, 12).readings.items():
        assert same_bits(values, expected[name]), name


def test_a_saved_state_with_a_reading_that_is_not_finite_is_refused() -> None:
    world = world_of(standing())
    saved = world.get_state()
    saved["reading"][0, 0, 0, 0, 1] = np.nan
    with pytest.raises(CoopenvError, match="state: field 'reading'"):
        world.set_state(saved)


def test_what_a_class_of_ones_own_can_sense_is_asked() -> None:
    sensor = {"kind": "tests.helpers.doppler:NearDoppler", "name": "near", "options": {"reach": 4.0}}
    description = sensing(sensor, vehicles=[vehicle()], landmarks=MARKS)
    assert_array_equal(measured(description, "near")[0], [True, False, True, False, False])


@pytest.mark.parametrize(
    ("kind", "problem"),
    [
        ("tests.helpers.doppler:Raising", "predict: RuntimeError: out of order"),
        ("tests.helpers.doppler:Unknown", "predict: not finite"),
    ],
)
def test_a_class_that_fails_in_a_world_is_named_in_one_line(kind: str, problem: str) -> None:
    description = sensing({"kind": kind}, vehicles=[vehicle()], landmarks=[landmark("off", (200.0, 0.0, 0.0))])
    with pytest.raises(CoopenvError) as caught:
        world_of(description)
    assert str(caught.value) == f"sensor '{kind}': {problem}"


def test_noise_with_other_rows_than_the_kind_is_refused() -> None:
    with pytest.raises(CoopenvError, match=r"sensors\.position\.noise: 2 numbers for 3 rows"):
        Simulated(standing(noise=[1.0, 2.0])).world(1, "float64", "cpu", None)


def test_a_limit_of_nearby_targets_is_refused_with_sensors() -> None:
    topology = {"mode": "sensed", "most_nearby": 3}
    with pytest.raises(ScenarioError, match=r"topology\.most_nearby: not with \[\[sensors\]\]"):
        sensing({"kind": "range"}, topology=topology)


@pytest.mark.parametrize("kind", KINDS)
def test_the_gramian_has_the_information_of_every_kind(kind: str) -> None:
    """By differences of the kind's prediction in NumPy, in the error (phi, d) of the map about its origin.

    A row counts by the ratio of the error across of a bearing at the target's distance to its own.
    """
    sensor = {"kind": kind, "name": "own", "towards": ["landmarks"], "noise": 0.05, **MOUNTING}
    exact = {"initial_estimate": {"orientation_angle": 0.0, "position_radius": 0.0}}
    car = vehicle((1.0, -1.0, 0.5), motion=constant([0.3, 0.0, 0.0], [0.0, 0.0, 0.2]), **exact)
    bearing = {"model": "isotropic", "scale": 0.01, "rate": 60.0}
    noise = {"enabled": False, "bearing": bearing}
    world = world_of(sensing(sensor, vehicles=[car], noise=noise, camera={"model": "none"}))
    made: Kind = kept_kind(kind, "{}")
    expected = np.zeros((6, 6))
    for target in range(4) if made.has_target else [0]:
        own, there = places(world, 0, target, sensor)
        value, columns = made.predict(own, there), []
        for axis in np.eye(6):
            turn, shift = 1e-6 * axis[:3], 1e-6 * axis[3:]
            R = np.eye(3) + np.cross(np.eye(3), turn)
            moved = Placed(own.position + np.cross(turn, own.position) + shift, R @ own.rotation, own.velocity, turn)
            columns.append(made.residual(made.predict(moved, there), value) / 1e-6)
        H = np.stack(columns, axis=-1)
        distance = np.linalg.norm(there.position - own.position) if made.has_target else 10.0
        expected += H.T @ H * (0.01 * distance / 0.05) ** 2
    found = {n: world.view(f"information_{n}")[0, 0, 0] for n in ("11", "12", "22")}
    whole = np.block([[found["11"], found["12"]], [found["12"].T, found["22"]]])
    assert_allclose(whole, expected, atol=2e-5 * max(1.0, np.abs(expected).max()))


def test_a_bearing_counts_in_the_gramian_as_one_of_the_camera() -> None:
    bearing = {"model": "isotropic", "scale": 0.01, "rate": 60.0}
    given = {"noise": {"enabled": False, "bearing": bearing}, "vehicles": [vehicle()]}
    sensor = {"kind": "bearing", "towards": ["landmarks"], "noise": 0.01}
    by_camera, by_sensor = world_of(sensing(**given)), world_of(sensing(sensor, camera={"model": "none"}, **given))
    for world in (by_camera, by_sensor):
        world.advance(6)
    for name in ("gramian_11", "gramian_12", "gramian_22", "gramian_time"):
        assert_allclose(by_sensor.view(name), by_camera.view(name), atol=2e-3, err_msg=name)


@pytest.mark.parametrize(
    ("declared", "variance"),
    [
        ({"bearing": {"correlated": {"std": 0.02, "time": 0.5}}}, lambda d, rate: 4e-4 * averaged_over(0.5)),
        ({"camera": {"latency_jitter": 0.05}}, lambda d, rate: (0.05 * rate) ** 2),
        ({"camera": {"latency_error": 0.05}}, lambda d, rate: 720.0 * (0.05 * rate) ** 2),
        ({"camera": {"extrinsics_walk": 1e-4}}, lambda d, rate: 720.0 * 12.0 * 1e-8),
        ({"map": {"accuracy": 0.03}}, lambda d, rate: 720.0 * (0.03 / d) ** 2),
    ],
)
def test_declared_errors_of_a_bearing_take_from_its_information(declared: dict[str, Any], variance: Any) -> None:
    """The white share of the variance: errors that last count for 12 s of frames, 720 at 60 Hz."""
    exact = {"initial_estimate": {"orientation_angle": 0.0, "position_radius": 0.0}}
    car = vehicle((1.0, -1.0, 0.5), motion=constant([0.3, 0.0, 0.0], [0.0, 0.0, 0.2]), **exact)
    white = {"model": "isotropic", "scale": 0.01, "rate": 60.0}
    gramians = []
    for more in ({}, declared):
        noise = {"bearing": white | more.get("bearing", {}), "velocity": 0.0, "angular_velocity": 0.0}
        sections = {name: keys for name, keys in more.items() if name != "bearing"} | {"noise": noise}
        world = world_of(sensing(vehicles=[car], landmarks=[landmark("A", (5.0, 3.0, 1.0))], **sections))
        world.advance(1)
        gramians.append(world.view("gramian_22")[0, 0].sum(axis=0))
    line = np.array([5.0, 3.0, 1.0]) - world.view("position")[0, 1]
    distance = np.linalg.norm(line)
    b, R = line / distance, world.view("rotation")[0, 1]
    turn, v = R @ np.array([0.0, 0.0, 0.2]), R @ np.array([0.3, 0.0, 0.0])
    rate = np.linalg.norm(np.cross(turn, b) + (v - (v @ b) * b) / distance)
    share = 1e-4 / (1e-4 + variance(distance, rate))
    assert_allclose(gramians[1], share * gramians[0], rtol=0.05)
    assert share < 0.9


def averaged_over(time: float) -> float:
    """Return how much a correlated error counts in a long mean, at 60 Hz."""
    r = np.exp(-1.0 / (60.0 * time))
    return float((1.0 + r) / (1.0 - r))
