"""Routes as they are drawn at a reset: which one, how far aside, how it wanders, and where the vehicle starts."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats

from coopenv.api.parallel_env import CooperativeLocalisationEnv
from coopenv.estimation.outcomes import Outcome
from coopenv.scenario import Scenario
from tests.helpers.builders import command, constant, reset, scenario, start, vehicle
from tests.helpers.warp_calls import DTYPES

WORLDS = 2000
STRAIGHT = {"name": "straight", "waypoints": [[-6.0, -0.5], [6.0, -0.5]]}
LEFT = {"name": "left", "waypoints": [[-6.0, -0.5], [0.5, -0.5], [0.5, 7.0]], "corner_radius": 2.0}
BODY = {"size": [0.5, 0.25, 0.25]}


def cars(*routes: dict[str, Any], count: int = 1, goal: dict[str, Any] | None = None, **car: Any) -> Scenario:
    names = [route["name"] for route in routes]
    one = {"routes": names, "motion": {"kind": "driven"}, **({"goal": goal} if goal else {}), **car}
    return scenario([one] * count, routes=list(routes), map={"origin": [1.0, 2.0, 0.25]}, horizon=60.0)


def drawn(made: Scenario, dtype: str = "float64", worlds: int = WORLDS) -> dict[str, np.ndarray]:
    return {name: np.asarray(v, float) for name, v in start(made, range(worlds), dtype).get_state().items()}


@pytest.mark.parametrize("dtype", DTYPES)
def test_a_route_without_spreads_is_the_designed_one(dtype: str) -> None:
    state = drawn(cars(LEFT), dtype, 3)
    count = int(state["route_count"][0, 0])
    x, y, s = state["route"][2, 0, :count].T + np.array([[1.0], [2.0], [0.0]])
    assert_allclose([x[0], y[0], x[-1], y[-1]], [-6.0, -0.5, 0.5, 7.0], atol=1e-5)
    assert s[-1] == pytest.approx(4.5 + np.pi + 5.5, rel=1e-3)
    assert_allclose(np.hypot(np.diff(x), np.diff(y)), np.diff(s), atol=1e-5)
    assert_allclose(state["goal"][:, 0] + [1.0, 2.0, 0.25], [[0.5, 7.0, 0.0]] * 3, atol=1e-6)
    assert_allclose(state["position"][:, -1] + [1.0, 2.0, 0.25], [[-6.0, -0.5, 0.0]] * 3, atol=1e-6)
    assert_allclose(state["rotation"][:, -1], np.tile(np.eye(3), (3, 1, 1)), atol=1e-6)


def test_routes_are_drawn_uniformly_and_vehicles_apart() -> None:
    state = drawn(cars(STRAIGHT, LEFT, {**STRAIGHT, "name": "again"}, count=2))
    which = state["route_drawn"].astype(int)
    assert stats.chisquare(np.bincount(which[:, 0])).pvalue > 1e-3
    assert stats.chisquare(np.bincount(3 * which[:, 0] + which[:, 1])).pvalue > 1e-3
    counts = state["route_count"]
    assert (counts[which == 1] > 2).all()
    assert (counts[which != 1] == 2).all()


def test_a_route_is_shifted_sideways_as_a_whole_and_begun_anywhere() -> None:
    state = drawn(cars({**LEFT, "lateral_spread": 0.4, "start_spread": 2.0}))
    shift = state["route"][:, 0, 0, 1] + 2.5
    assert stats.kstest(shift / 0.8 + 0.5, "uniform").pvalue > 1e-3
    assert_allclose(state["goal"][:, 0, 0] + 0.5, -shift, atol=1e-5)
    x, y = state["position"][:, -1, 0] + 7.0, state["position"][:, -1, 1] + 2.5
    assert_allclose(y, shift, atol=1e-5)
    assert stats.kstest(x / 2.0, "uniform").pvalue > 1e-3
    assert abs(np.corrcoef(x, shift)[0, 1]) < 0.08


def test_a_wandering_route_keeps_its_ends_and_its_bounds() -> None:
    state = drawn(cars({**STRAIGHT, "wander": 0.5}))
    aside = state["route"][:, 0, :49, 1] + 2.5
    assert_allclose(aside[:, [0, -1]], 0.0, atol=1e-6)
    assert 0.3 < np.abs(aside).max() <= 0.5
    assert (np.abs(aside).max(axis=1) > 0.02).all()
    assert_allclose(aside.mean(axis=0), 0.0, atol=0.03)
    lengths = state["route"][:, 0, 48, 2]
    assert (lengths > 12.0 - 1e-5).all()
    assert (lengths < 12.5).all()


def test_the_spreads_of_the_start_are_about_the_route() -> None:
    pose = {"position_spread": [0.3, 0.1, 0.0], "yaw_spread": 0.2}
    state = drawn(cars({**LEFT, "waypoints": [[0, 0], [0, 9]]}, initial_pose=pose))
    offset = state["position"][:, -1, :2] + [1.0, 2.0]
    assert_allclose(np.abs(offset).max(axis=0), [0.1, 0.3], rtol=0.01)
    yaw = np.arctan2(state["rotation"][:, -1, 1, 0], state["rotation"][:, -1, 0, 0]) - np.pi / 2
    assert np.abs(yaw).max() == pytest.approx(0.2, rel=0.01)


def test_starts_on_one_route_do_not_touch() -> None:
    state = drawn(cars({**STRAIGHT, "start_spread": 6.0}, count=3, body=BODY))
    x = np.sort(state["position"][:, -3:, 0], axis=1)
    assert np.diff(x, axis=1).min() > 0.5
    assert not state["collided"].any()


def test_episodes_and_worlds_differ_and_repeat() -> None:
    made = cars({**LEFT, "lateral_spread": 0.4, "wander": 0.2, "start_spread": 1.0})
    world = start(made, [5, 6])
    first = world.get_state()["route"]
    assert not np.allclose(first[0], first[1])
    reset(world)
    assert not np.allclose(world.get_state()["route"], first)
    np.testing.assert_array_equal(start(made, [5, 6]).get_state()["route"], first)


def test_without_routes_the_way_is_straight_to_the_goal() -> None:
    goal = {"position": [3.0, 4.0, 0.0], "radius": 0.5}
    pose = {"position": [0.0, 0.0, 0.0], "position_spread": [0.5, 0.5, 0.0]}
    other = vehicle((0.0, 9.0, 0.0))
    already = vehicle((5.0, 5.0, 0.0), goal={"position": [5.0, 5.0, 0.0], "radius": 0.5})
    state = drawn(scenario([{"initial_pose": pose, "goal": goal}, other, already]), "float64", 5)
    np.testing.assert_array_equal(state["route_count"], np.tile([2, 0, 0], (5, 1)))
    np.testing.assert_array_equal(state["route_drawn"], -1)
    assert_allclose(state["route"][:, 0], np.tile([[0.0, 0.0, 0.0], [3.0, 4.0, 5.0]], (5, 1, 1)), atol=1e-6)
    assert_allclose(state["goal"][:, 0], np.tile([3.0, 4.0, 0.0], (5, 1)))


def arrives(made: Scenario, places: np.ndarray) -> np.ndarray:
    """Return (W,) whether a car that stands at a place (W, 2) of the file's coordinates has arrived."""
    world = start(made, range(len(places)))
    state = world.get_state()
    state["position"][:, -1, :2] = places - [1.0, 2.0]
    world.set_state(state)
    command(world, (-1.0, 0.0))
    world.advance(1)
    return np.asarray(world.get_state()["ended"][:, 0] == Outcome.ARRIVED)


def test_past_the_end_is_an_arrival_within_the_radius_alone() -> None:
    made = cars({**STRAIGHT, "waypoints": [[0.0, 0.0], [2.0, 0.0]]}, goal={"radius": 0.5})
    x, y = np.meshgrid(np.arange(0.03, 6.0, 0.1), np.arange(-1.02, 1.1, 0.06))
    places = np.column_stack([x.ravel(), y.ravel()])
    near = np.hypot(places[:, 0] - 2.0, places[:, 1]) < 0.5
    beyond = (places[:, 0] >= 2.0) & (np.abs(places[:, 1]) < 0.5)
    np.testing.assert_array_equal(arrives(made, places), near | beyond)


def test_a_loop_does_not_end_where_it_crosses_the_prolongation_of_its_end() -> None:
    loop = [[0.0, 0.0], [6.0, 0.0], [6.0, 4.0], [3.0, 4.0], [3.0, 1.0]]
    made = cars({"name": "loop", "waypoints": loop, "corner_radius": 0.5}, goal={"radius": 0.5})
    along = np.column_stack([np.arange(0.0, 5.5, 0.1), np.zeros(55)])
    assert not arrives(made, along).any()
    assert arrives(made, np.array([[3.0, 1.2], [3.2, 0.7]])).all()


def test_progress_is_along_the_route() -> None:
    made = scenario(
        [{"routes": ["left"], "motion": {"kind": "driven"}}, vehicle(motion=constant([1.0, 0, 0]))],
        routes=[LEFT],
        horizon=4.0,
        reward={"weights": {"progress": 1.0}, "privileged": True},
    )
    env = CooperativeLocalisationEnv(made, "test")
    env.reset(seed=0)
    total = 0.0
    while env.agents:
        _, rewards, *_ = env.step({agent: np.array([0.5, 0.1], np.float32) for agent in env.agents})
        assert rewards["vehicle_2"] == 0.0
        total += rewards["vehicle_1"]
    place = env.engine.view("position")[0, -2, :2]
    assert place[0] < -1.5  # before the corner
    assert total == pytest.approx(place[0] + 6.0, abs=0.01)
