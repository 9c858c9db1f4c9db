"""Draws of a world at a reset beside routes: landmarks, presence, pace, factors of parameters."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy import stats
from scipy.spatial.transform import Rotation

from coopenv.base.seeds import evaluation_seed
from coopenv.estimation import Sight
from coopenv.scenario import Scenario
from coopenv.scenario.difficulty import PARAMETERS
from tests.helpers.builders import constant, estimated_position, landmark, raw, reset, run, scenario, start, vehicle
from tests.helpers.warp_calls import DTYPES

WORLDS = 3000
CELLS = 16
GROUPS = [
    {
        "name": "area",
        "count": 2,
        "boxes": [{"center": [5, 5], "half": [2, 1]}, {"center": [-5, 0], "half": [1, 1]}],
        "height": [0.5, 1.5],
    },
    {"name": "kerb", "count": 1, "lines": [{"start": [-4, 3], "end": [4, -3]}], "height": [0.3, 0.3]},
]


def field(made: Scenario, name: str, seeds: Any = range(WORLDS), dtype: str = "float64") -> np.ndarray:
    return np.asarray(start(made, seeds, dtype).get_state()[name], float)


def spread_landmarks(**more: Any) -> Scenario:
    mark = landmark("A", (1.0, 2.0, 1.0), yaw=0.5, position_spread=[2.0, 1.0, 0.5], **more)
    return scenario([vehicle()], landmarks=[mark], map={"origin": [0.5, 0.5, 0.0]})


def in_units(places: np.ndarray) -> np.ndarray:
    """Return offsets of landmark A in [0, 1] of its spread."""
    offset = (places - [0.5, 1.5, 1.0]) @ Rotation.from_euler("z", 0.5).as_matrix()
    return offset / [4.0, 2.0, 1.0] + 0.5


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("first", [0, evaluation_seed(0)])
def test_every_coordinate_of_a_landmark_is_uniform_in_training_and_evaluation(first: int, dtype: str) -> None:
    units = in_units(field(spread_landmarks(), "position", range(first, first + WORLDS), dtype)[:, 0])
    for axis in range(3):
        assert stats.kstest(units[:, axis], "uniform").pvalue > 1e-3
        assert stats.chisquare(np.bincount((CELLS * units[:, axis]).astype(int), minlength=CELLS)).pvalue > 1e-3
    for a, b in ((0, 1), (0, 2), (1, 2)):
        assert abs(np.corrcoef(units[:, a], units[:, b])[0, 1]) < 0.07


def parity(units: np.ndarray) -> np.ndarray:
    return np.asarray(np.floor(CELLS * units).astype(int).sum(axis=-1) % 2)


@pytest.mark.parametrize("spread", [[2.0, 1.0, 0.5], [2.0, 0.0, 0.0], [0.0, 1.0, 0.5]])
def test_held_out_maps_share_no_cell_with_those_for_training(spread: list[float]) -> None:
    made = scenario([vehicle()], landmarks=[landmark("A", (0.0, 0.0, 1.0), position_spread=spread)])
    size = 2.0 * np.where(np.array(spread) > 0, spread, np.inf)
    for first, expected in ((0, 0), (evaluation_seed(5000), 1)):
        units = (field(made, "position", range(first, first + 500))[:, 0] - [0.0, 0.0, 1.0]) / size + 0.5
        assert_array_equal(parity(units[:, np.array(spread) > 0]), expected)


def test_held_out_routes_share_no_cell_with_those_for_training() -> None:
    route = {"name": "way", "waypoints": [[0, 0], [9, 0]], "lateral_spread": 0.5, "start_spread": 2.0}
    made = scenario([{"routes": ["way"], "motion": {"kind": "driven"}}], routes=[route])
    shifted = scenario([{"routes": ["way"], "motion": {"kind": "driven"}}], routes=[{**route, "start_spread": 0.0}])
    for first, expected in ((0, 0), (evaluation_seed(0), 1)):
        state = start(made, range(first, first + 800)).get_state()
        shift, begin = state["route"][:, 0, 0, 1] + 0.5, state["start_position"][:, -1, 0] / 2.0
        assert_array_equal(parity(np.column_stack([shift, begin])), expected)
        assert stats.kstest(shift, "uniform").pvalue > 1e-3
        assert stats.kstest(begin, "uniform").pvalue > 1e-3
        alone = field(shifted, "route", range(first, first + 200))[:, 0, 0, 1:2] + 0.5
        assert_array_equal(parity(alone), expected)


def test_groups_fill_their_areas_and_lines_uniformly() -> None:
    made = scenario([vehicle()], landmark_groups=GROUPS, map={"origin": [1.0, 0.0, 0.0]})
    assert made.target_names[4:] == ["area_1", "area_2", "kerb_1", "vehicle_1"]
    places = field(made, "position") + np.array([1.0, 0.0, 0.0])
    for mark in (4, 5):
        x, y, z = places[:, mark].T
        large = x > 0
        assert stats.binomtest(int(large.sum()), WORLDS, 8 / 12).pvalue > 1e-3
        assert stats.kstest((x[large] - 3.0) / 4.0, "uniform").pvalue > 1e-3
        assert stats.kstest((y[large] - 4.0) / 2.0, "uniform").pvalue > 1e-3
        assert stats.kstest((x[~large] + 6.0) / 2.0, "uniform").pvalue > 1e-3
        assert stats.kstest(z - 0.5, "uniform").pvalue > 1e-3
    assert abs(np.corrcoef(places[:, 4, 2], places[:, 5, 2])[0, 1]) < 0.07
    x, y, z = places[:, 6].T
    assert_allclose(y, -0.75 * x, atol=1e-5)
    assert_allclose(z, 0.3, atol=1e-6)
    assert np.abs(x).max() > 3.5
    training = stats.kstest((x + 4.0) / 8.0, "uniform").statistic
    assert training < 0.09  # along one axis every other sixteenth is left out


def test_landmarks_are_there_with_a_probability() -> None:
    marks = [landmark("often", (2.0, 0.5, 1.0), presence=0.8), landmark("never", (2.0, -0.5, 1.0), presence=0.0)]
    group = {**GROUPS[0], "presence": 0.3}
    made = scenario([vehicle()], landmarks=marks, landmark_groups=[group])
    present = field(made, "present")
    for mark, chance in enumerate([0.8, 0.0, 0.3, 0.3, 1.0]):
        assert stats.binomtest(int(present[:, mark].sum()), WORLDS, chance).pvalue > 1e-3
    for mode in ("fixed", "sensed"):
        sight = start(scenario([vehicle()], landmarks=marks, topology={"mode": mode}), range(50)).get_state()
        seen = sight["sight"][:, 0, :2] == Sight.VISIBLE
        assert_array_equal(seen, sight["present"][:, :2] == 1)


def test_absent_agents_hide_nothing_and_are_no_obstacles() -> None:
    wall = landmark("wall", (2.0, 0.0, 0.5), body={"size": [0.5, 3.0, 2.0]}, presence=0.5)
    behind = landmark("behind", (4.0, 0.0, 0.5))
    inside = vehicle((2.0, 0.0, 0.5), body={"size": [0.5, 0.3, 0.3]}, presence=0.5)
    made = scenario([vehicle(), inside], landmarks=[wall, behind], topology={"mode": "sensed", "acyclic": False})
    state = start(made, range(200)).get_state()
    wall_there, car_there = state["present"][:, 0] == 1, state["present"][:, 3] == 1
    assert len({*zip(wall_there.tolist(), car_there.tolist(), strict=True)}) == 4
    assert_array_equal(state["sight"][:, 0, 1] == Sight.VISIBLE, ~wall_there & ~car_there)
    assert_array_equal(state["collided"][:, 1] == 1, wall_there & car_there)
    assert_array_equal(state["ended"][:, 1] == -1, ~car_there)
    assert (state["sight"][~car_there][:, 1] != Sight.VISIBLE).all()
    assert_array_equal(state["outbox_tick"][:, 1, 0] == 0, car_there)


def test_one_vehicle_is_always_left_and_it_is_driven() -> None:
    driven = {"motion": {"kind": "driven"}, "presence": 0.0}
    others = [vehicle((0.0, y, 0.0), **driven) for y in (2.0, 4.0)]
    made = scenario([vehicle((0.0, 0.0, 0.0)), *others])
    present = field(made, "present")[:, -3:]
    assert present[:, 0].all()
    assert (present[:, 1:].sum(axis=1) == 1).all()
    assert stats.binomtest(int(present[:, 1].sum()), WORLDS, 0.5).pvalue > 1e-3
    alone = scenario([vehicle((0.0, 2.0 * y, 0.0), presence=0.0) for y in range(3)])
    assert (field(alone, "present")[:, -3:].sum(axis=1) == 1).all()


def test_pace_scales_motion_twist_and_odometry() -> None:
    """A half turn of radius 1 m in 4 s at pace 1, then a rest."""
    turn = {
        "kind": "segments",
        "segments": [{"duration": 4.0, "linear": [np.pi / 4, 0, 0], "angular": [0, 0, np.pi / 4]}],
    }
    mover = landmark("mover", (0.0, 5.0, 1.0), motion=turn, pace_spread=0.4)
    made = scenario([vehicle(motion=turn, pace_spread=0.5)], landmarks=[mover], horizon=5.0)
    world = start(made, range(300))
    pace = world.get_state()["pace"].astype(float)
    assert stats.kstest((pace[:, 0] - 0.6) / 0.8, "uniform").pvalue > 1e-3
    assert stats.kstest(pace[:, 1] - 0.5, "uniform").pvalue > 1e-3
    state = run(world, 120)[-1]
    angle = np.minimum(2.0 * pace, 4.0) * np.pi / 4
    moving = 2.0 * pace < 4.0
    moved = state["position"][..., :2] - np.array([[0.0, 5.0], [0.0, 0.0]])
    assert_allclose(moved, np.stack([np.sin(angle), 1 - np.cos(angle)], axis=-1), atol=2e-4)
    assert_allclose(state["velocity"][..., 0], np.where(moving, pace * np.pi / 4, 0.0), atol=1e-5)
    rate = np.where(moving[:, 1], pace[:, 1] * np.pi / 4, 0.0)
    assert_allclose(state["odometry_angular_velocity"][:, 0, 2], rate, atol=1e-5)
    assert_allclose(state["odometry_velocity"][:, 0, 0], rate, atol=1e-5)


def test_a_fast_pace_does_not_outrun_the_table_of_a_long_motion() -> None:
    path = {"kind": "waypoints", "waypoints": [{"time": 10.0 * k, "position": [5.0 * k, 0, 0]} for k in range(8)]}
    other = {"traffic_pace": [3.0, 3.0]}
    made = scenario([vehicle((0.0, 9.0, 0.0)), {"motion": path}], randomisation=other, horizon=20.0)
    place = run(start(made), 1200)[-1]["position"][0, -1]
    assert place[0] == pytest.approx(30.0, abs=0.05)


def test_start_speeds_spread_within_what_the_vehicle_can() -> None:
    motion = {"kind": "driven", "initial_speed": 1.0, "initial_speed_spread": 0.8}
    speed = field(scenario([vehicle(motion=motion)], dynamics={"max_speed": 1.5}), "speed")[:, 0]
    assert speed.min() < 0.22
    assert stats.binomtest(int((speed == 1.5).sum()), WORLDS, 0.3 / 1.6).pvalue > 1e-3
    free = speed[speed < 1.5]
    assert stats.kstest((free - 0.2) / 1.3, "uniform").pvalue > 1e-3


def parameters(made: Scenario, **settings: Any) -> np.ndarray:
    world = start(made, range(WORLDS))
    if settings:
        world.set_parameters({k: np.broadcast_to(v, WORLDS) for k, v in settings.items()}, np.ones(WORLDS, bool))
        reset(world)
    return np.asarray(world.get_state()["parameter"])


def test_parameters_are_drawn_from_their_range_times_the_difficulty() -> None:
    made = scenario(
        randomisation={"camera_range": [0.5, 1.0], "slip": [2.0, 2.0]},
        difficulty={"level": "hard", "camera_range": [1.0, 0.5], "wander": [0.0, 3.0]},
    )
    for settings, level in (({}, 1.0), ({"difficulty": 0.25}, 0.25)):
        found = parameters(made, **settings)
        columns = {name: found[:, k] for k, name in enumerate(PARAMETERS)}
        reach = columns.pop("camera_range") / (1.0 - 0.5 * level)
        assert stats.kstest((reach - 0.5) / 0.5, "uniform").pvalue > 1e-3
        assert_allclose(columns.pop("slip"), 2.0)
        assert_allclose(columns.pop("wander"), 3.0 * level)
        for column in columns.values():
            assert_array_equal(column, 1.0)


def test_a_set_parameter_holds_until_it_is_set_again() -> None:
    world = start(scenario(randomisation={"camera_range": [0.5, 1.0]}), range(4))
    column = list(PARAMETERS).index("camera_range")
    world.set_parameters({"camera_range": np.array([0.1, 0.2, 0.3, 0.4])}, np.array([True, True, False, False]))
    for _ in range(3):
        reset(world)
        found = world.get_state()["parameter"][:, column]
        assert_allclose(found[:2], [0.1, 0.2])
        assert (found[2:] >= 0.5).all()
    world.set_parameters({"camera_range": np.full(4, np.nan)}, np.ones(4, bool))
    reset(world)
    assert (world.get_state()["parameter"][:, column] >= 0.5).all()


NOISY = {
    "noise": {
        "velocity": 0.1,
        "angular_velocity": 0.1,
        "bearing": {"scale": 0.01},
        "odometry_scale": 0.05,
        "gyro_bias": 0.02,
        "slip": {"rate": 1.0, "size": 0.5},
    },
    "camera": {"range": 5.0, "extrinsics_error": 0.02, "extrinsics_position_error": 0.01},
    "topology": {"mode": "sensed", "acyclic": False},
    "v2x": {"loss": 0.3},
}


def effects(state: dict[str, np.ndarray]) -> dict[str, float]:
    """Return a figure of each parameter that follows it, from states with it and with factors of one."""
    L = 4
    offset = estimated_position(state) - state["position"][:, L:]
    return {
        "odometry_scale": float(np.std(state["odometry_scale"])),
        "gyro_bias": float(np.std(state["gyro_bias"])),
        "extrinsics": float(np.std(state["camera_turn"])),
        "initial_error": float(np.linalg.norm(offset, axis=-1).max()),
        "landmark_presence": float(state["present"][:, :L].mean()),
        "wander": float(np.abs(state["route"][:, 0, :, 1]).max()),
        "traffic_pace": float(state["pace"][:, -1].mean()),
    }


def test_parameters_scale_what_they_are_named_after_at_a_reset() -> None:
    marks = [landmark(f"L{k}", (2.0 * k, 3.0, 1.0), presence=0.5) for k in range(4)]
    belief = {"position_radius": 0.5, "orientation_angle": 0.1}
    cars = [
        {"routes": ["way"], "motion": {"kind": "driven"}, "initial_estimate": belief},
        vehicle((0.0, -3.0, 0.0), motion=constant([1.0, 0.0, 0.0]), initial_estimate=belief, pace_spread=0.2),
    ]
    way = {"name": "way", "waypoints": [[0, 0], [9, 0]], "wander": 0.4}
    made = scenario(cars, landmarks=marks, routes=[way], **NOISY)
    world = start(made, range(400))
    plain = effects(world.get_state())
    everywhere = np.ones(400, bool)
    for name, before in plain.items():
        factor = 1.6 if name in ("landmark_presence", "traffic_pace") else 0.5
        world.set_parameters({name: np.full(400, factor)}, everywhere)
        reset(world, range(400))
        after = effects(world.get_state())
        for other, value in after.items():
            expected = plain[other] * (factor if other == name else 1.0)
            tolerance = 0.06 if name == other == "landmark_presence" else 1e-6
            assert value == pytest.approx(expected, rel=tolerance), (name, other)
        world.set_parameters({name: np.full(400, np.nan)}, everywhere)
        assert before > 0.0


def test_parameters_scale_noise_range_loss_and_slip_on_the_way() -> None:
    cars = [vehicle((0, 0, 0), motion=constant([1.0, 0, 0])), vehicle((0, -2, 0), motion=constant([1.0, 0, 0]))]
    made = scenario(cars, **NOISY)
    world = start(made, range(200))

    def figures(**factors: float) -> dict[str, float]:
        world.set_parameters({k: np.full(200, v) for k, v in factors.items()}, np.ones(200, bool))
        reset(world, range(200))
        states = run(world, 12)
        last = states[-1]
        world.set_parameters({k: np.full(200, np.nan) for k in factors}, np.ones(200, bool))
        return {
            "odometry_noise": float(np.std(last["odometry_velocity"][..., 1:])),
            "camera_range": float((last["sight"][..., :4] == Sight.VISIBLE).sum()),
            "slip": float((last["slip"][..., 0] != 0).mean()),
            "v2x_loss": float(np.mean([(s["inbox_tick"][:, 1, 0] != k) for k, s in enumerate(states)][1:])),
        }

    plain = figures()
    assert figures(odometry_noise=3.0)["odometry_noise"] == pytest.approx(3.0 * plain["odometry_noise"], rel=1e-6)
    assert figures(camera_range=0.6)["camera_range"] < plain["camera_range"]
    assert figures(slip=0.0)["slip"] == 0.0 < plain["slip"] < figures(slip=8.0)["slip"]
    assert figures(v2x_loss=0.0)["v2x_loss"] == 0.0 < plain["v2x_loss"]
    assert figures(v2x_loss=2.0)["v2x_loss"] == pytest.approx(0.6, abs=0.05)


def test_the_noise_of_bearings_is_scaled() -> None:
    world = start(scenario(noise={"bearing": {"scale": 0.01}}), range(200))
    seen = []
    for factor in (0.0, 1.0, 3.0):
        world.set_parameters({"bearing_noise": np.full(200, factor)}, np.ones(200, bool))
        reset(world, range(200))
        seen.append(world.get_state()["bearing"])
    once, thrice = (np.std(bearing - seen[0]) for bearing in seen[1:])
    assert once == pytest.approx(0.01 * np.sqrt(2 / 3 * 4 / 5), rel=0.1)  # two of three axes; four of five targets
    assert thrice == pytest.approx(3.0 * once, rel=1e-2)


def test_data_of_groups_is_kept_through_json() -> None:
    """As recordings keep a scenario: its groups do not draw their landmarks twice."""
    made = scenario([vehicle()], landmark_groups=GROUPS)
    again = raw() | made.model_dump(mode="json", exclude_none=True)
    sections = {k: v for k, v in again.items() if k != "vehicles"}
    assert scenario(again["vehicles"], **sections).target_names == made.target_names
