"""Routes: places on a line against closed forms, what is drawn at a reset, and what follows an arrival."""

from __future__ import annotations

import string
from typing import Any

import numpy as np
import pytest
import warp as wp
from numpy.testing import assert_allclose
from scipy import stats

import coopenv
from coopenv import ScenarioError
from coopenv.api.parallel_env import CooperativeLocalisationEnv
from coopenv.estimation import Outcome, Sight
from coopenv.scenario import Scenario
from coopenv.world.launch import compiler_options, start_warp
from coopenv.world.model import precision
from coopenv.world.route import place_on_route, point_on_route
from coopenv.world.state import allocate, state_struct
from tests.helpers.builders import command, constant, reset, run, scenario, start, vehicle
from tests.helpers.four_way import FOUR_WAY
from tests.helpers.warp_calls import DTYPES

start_warp()
wp.set_module_options(compiler_options())


@wp.kernel(enable_backward=False)
def places_kernel(state: Any, query: wp.array(dtype=Any), found: wp.array(dtype=Any)):
    """Find the place of every query (x, y, -)."""
    i = wp.tid()
    q = query[i]
    s, lateral, heading = place_on_route(state, 0, 0, q[0], q[1])
    found[i] = type(q)(s, lateral, heading)


@wp.kernel(enable_backward=False)
def points_kernel(state: Any, query: wp.array(dtype=Any), found: wp.array(dtype=Any)):
    """Find the point at every query (s, -, -)."""
    i = wp.tid()
    q = query[i]
    x, y, heading = point_on_route(state, 0, 0, q[0])
    found[i] = type(q)(x, y, heading)


for dtype in DTYPES:  # one module for both precisions
    state_type, vectors = state_struct(precision(dtype)), wp.array(dtype=precision(dtype).vec3)
    for kernel in (places_kernel, points_kernel):
        wp.overload(kernel, [state_type, vectors, vectors])


def _found(function: Any, dtype: str, line: np.ndarray, query: np.ndarray) -> np.ndarray:
    p = precision(dtype)
    sizes = {**dict.fromkeys(string.ascii_uppercase, 1), "P": max(len(line), 1)}
    state = allocate(state_struct(p), sizes, "cpu")
    steps = np.linalg.norm(np.diff(line, axis=0), axis=1)
    if len(line):
        state.route.numpy()[0, 0] = np.column_stack([line, np.concatenate([[0.0], np.cumsum(steps)])])
        state.route_count.numpy()[0, 0] = len(line)
    given = wp.array(np.ascontiguousarray(query, dtype=p.numpy), dtype=p.vec3, device="cpu")
    found = wp.zeros_like(given)
    wp.launch(function, dim=len(query), inputs=[state, given, found], device="cpu")
    return np.asarray(found.numpy(), dtype=float)


def places(dtype: str, line: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Return (s, lateral, heading), (K, 3), of the points xy (K, 2) by the route with points `line` (P, 2)."""
    return _found(places_kernel, dtype, line, np.column_stack([xy, np.zeros(len(xy))]))


def points(dtype: str, line: np.ndarray, s: np.ndarray) -> np.ndarray:
    """Return (x, y, heading), (K, 3), at arc lengths s (K,)."""
    return _found(points_kernel, dtype, line, np.column_stack([s, s, s]))


@pytest.mark.parametrize("dtype", DTYPES)
def test_a_straight_line_and_its_prolongations(dtype: str) -> None:
    rng = np.random.default_rng(0)
    angle, begin = 0.7, np.array([3.0, -2.0])
    ahead, left = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    s, aside = rng.uniform(-5.0, 15.0, 200), rng.uniform(-4.0, 4.0, 200)
    xy = begin + s[:, None] * ahead + aside[:, None] * left
    for count in (2, 7):
        line = begin + np.linspace(0.0, 10.0, count)[:, None] * ahead
        assert_allclose(places(dtype, line, xy), np.column_stack([s, aside, np.full(200, angle)]), atol=1e-4)
        found = points(dtype, line, s)
        assert_allclose(found[:, :2], begin + s[:, None] * ahead, atol=1e-4)
        assert_allclose(found[:, 2], angle, atol=1e-5)


def test_an_arc() -> None:
    """A chord of 1/20 of a radius is within 1/3200 of it from the arc; s is then right to within half of a chord."""
    radius, turn = 2.0, 3.0
    angles = np.linspace(0.0, turn, 61)
    line = radius * np.column_stack([np.sin(angles), 1.0 - np.cos(angles)])
    rng = np.random.default_rng(1)
    at, aside = rng.uniform(0.05, turn - 0.05, 300), rng.uniform(-1.0, 1.0, 300)
    xy = (radius - aside)[:, None] * np.column_stack([np.sin(at), -np.cos(at)]) + [0.0, radius]
    s, lateral, heading = places("float64", line, xy).T
    assert_allclose(s, radius * at, atol=0.05)
    assert_allclose(lateral, aside, atol=1e-3)
    assert_allclose(heading, at, atol=0.025)
    x, y, heading = points("float64", line, radius * at).T
    assert_allclose(x, radius * np.sin(at), atol=1.5e-3)
    assert_allclose(y, radius * (1 - np.cos(at)), atol=1.5e-3)
    assert_allclose(heading, at, atol=2.5e-3)


def test_the_place_is_the_nearest_one_of_a_crooked_line() -> None:
    """Against 20,000 points of the line; the place and the offset say where the point is nearest."""
    rng = np.random.default_rng(2)
    line = np.cumsum(rng.normal([1.0, 0.0], 0.5, (15, 2)), axis=0)
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    xy = rng.uniform(line.min(0) + 0.5, line.max(0) - 0.5, (200, 2))
    fine = np.linspace(0.0, lengths[-1], 20001)
    dense = np.column_stack([np.interp(fine, lengths, line[:, k]) for k in (0, 1)])
    distance = np.linalg.norm(xy[:, None] - dense, axis=-1).min(axis=1)
    s, lateral, _ = places("float64", line, xy).T
    inside = (s > 0) & (s < lengths[-1])
    assert inside.sum() > 150
    assert_allclose(np.abs(lateral[inside]), distance[inside], atol=2e-3)
    there = points("float64", line, s)[inside, :2]
    assert_allclose(np.linalg.norm(there - xy[inside], axis=1), distance[inside], atol=2e-3)


def test_no_route() -> None:
    nothing = np.zeros((0, 2))
    assert_allclose(places("float64", nothing, np.array([[3.0, 4.0]])), 0.0)
    assert_allclose(points("float64", nothing, np.array([3.0])), 0.0)


def test_a_vehicle_that_leaves_its_route_ends_there() -> None:
    overrides = {"termination.off_route": 1.5, "obstacles": []}
    env = coopenv.parallel_env(FOUR_WAY, overrides=overrides)
    _, infos = env.reset(seed=0)
    goal, left = np.array(env.scenario.vehicles[0].goal.position[:2]), 0
    begin = infos["vehicle_1"]["truth"]["position"][:2]
    along = (goal - begin) / np.linalg.norm(goal - begin)
    while "vehicle_1" in env.agents:  # a circle to the left
        _, _, terminated, _, infos = env.step({agent: np.array([1.0, 0.5]) for agent in env.agents})
        x, y = infos["vehicle_1"]["truth"]["position"][:2] - begin
        left = max(abs(along[0] * y - along[1] * x), -(along[0] * x + along[1] * y))
        assert terminated["vehicle_1"] == (left > 1.5)
    assert infos["vehicle_1"]["outcome"] == "off route"
    assert infos["vehicle_1"]["reward_terms"]["collision"] == 0.0


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
        assert rewards.keys() == {"vehicle_1"}
        total += rewards["vehicle_1"]
    place = env.engine.view("position")[0, -2, :2]
    assert place[0] < -1.5  # before the corner
    assert total == pytest.approx(place[0] + 6.0, abs=0.01)


CHASE_BODY = {"size": [0.5, 0.25, 0.25]}
DRIVEN = {"kind": "driven"}
CHASE = [
    vehicle((0.0, 0.0, 0.0), body=CHASE_BODY, motion=DRIVEN, goal={"position": [1.5, 0, 0], "radius": 0.3}),
    vehicle((-1.5, 0.0, 0.0), body=CHASE_BODY, motion=DRIVEN, goal={"position": [9.0, 0, 0], "radius": 0.3}),
]


def chase(after: str) -> list[dict[str, np.ndarray]]:
    """Return the states of a pair of which the leader's goal lies in the follower's way."""
    made = scenario(
        CHASE, termination={"after_arrival": after}, topology={"mode": "sensed", "acyclic": False}, horizon=30.0
    )
    world = start(made)
    command(world, [0.0, 0.0])
    return run(world, 480)


@pytest.mark.parametrize("after", ["park", "leave"])
def test_a_follower_hits_a_parked_vehicle_and_passes_one_that_leaves(after: str) -> None:
    states = chase(after)
    ended = np.array([state["ended"][0] for state in states])
    first = int(np.argmax(ended[:, 0] == Outcome.ARRIVED))
    assert first > 0
    assert (ended[first:, 0] == Outcome.ARRIVED).all()
    assert (ended[-1, 1] == Outcome.COLLIDED) == (after == "park")
    present = np.array([state["present"][0, -2] for state in states])
    np.testing.assert_array_equal(present, (np.arange(481) <= first) | (after == "park"))
    seen = np.array([state["sight"][0, 1, -2] == Sight.VISIBLE for state in states])
    np.testing.assert_array_equal(seen, present == 1)
    sent = np.array([state["outbox_tick"][0, 0].max() for state in states])
    assert (sent[first + 3 :] <= first).all() == (after == "leave")
    assert [state["arrivals"][0, 0] for state in states] == [0] * first + [1] * (481 - first)


SQUARE = [
    {"name": "south", "waypoints": [[0, 0], [4, 0]]},
    {"name": "east", "waypoints": [[4, 0], [4.1, 0], [8, 0]]},
    {"name": "north", "waypoints": [[4, 0], [7, 0]], "lateral_spread": 0.1},
    {"name": "back", "waypoints": [[8, 0], [11, 0]]},
    {"name": "home", "waypoints": [[7, 0], [11.2, 0]]},
    {"name": "far", "waypoints": [[11, 0], [30, 0]]},
]


def walker(**more: Any) -> Any:
    one = {"routes": ["south"], "motion": {"kind": "driven", "initial_speed": 1.0}, "goal": {"radius": 0.4}, **more}
    routes = [
        *SQUARE,
        {"name": "last", "waypoints": [[30, 0], [60, 0]]},
        {"name": "end", "waypoints": [[60, 0], [90, 0]]},
    ]
    loop = {"name": "loop", "waypoints": [[90, 0], [99, 0], [99, 9], [90, 9], [90, 0.3]], "corner_radius": 1.0}
    return scenario([one], routes=[*routes, loop], termination={"after_arrival": "continue"}, horizon=60.0)


def test_a_vehicle_that_continues_draws_what_starts_where_it_has_arrived() -> None:
    made = walker()
    names = [route.name for route in made.routes]
    world = start(made, range(400))
    command(world, [1.0, 0.0])
    second, arrivals = np.full(400, -1), np.zeros(400, int)
    for _ in range(60):
        world.advance(10)
        state = world.get_state()
        changed = (state["arrivals"][:, 0] == 1) & (second < 0)
        second[changed] = state["route_drawn"][changed, 0]
        assert (np.diff(np.stack([arrivals, state["arrivals"][:, 0]]), axis=0) >= 0).all()
        arrivals = state["arrivals"][:, 0]
        assert (state["ended"] == Outcome.UNDER_WAY).all()
    east, north = names.index("east"), names.index("north")
    assert {*second.tolist()} == {east, north}
    assert stats.binomtest(int((second == east).sum()), 400, 0.5).pvalue > 1e-3
    assert arrivals.min() >= 2
    goal, count = state["goal"][:, 0, :2], state["route_count"][:, 0]
    np.testing.assert_array_equal(state["route"][np.arange(400), 0, count - 1, :2], goal)


def test_next_routes_restrict_what_follows() -> None:
    names = [route.name for route in walker().routes]
    world = start(walker(next_routes=[name for name in names if name != "north"]), range(50))
    command(world, [1.0, 0.0])
    states = run(world, 300)
    assert {*states[-1]["route_drawn"][:, 0].tolist()} == {names.index("east")}


@pytest.mark.parametrize(
    ("sections", "message"),
    [
        ({"termination": {"after_arrival": "leave", "arrival": False}}, "termination.arrival: must be true"),
        ({"termination": {"after_arrival": "vanish"}}, "termination.after_arrival"),
        ({"termination": {"after_arrival": "continue"}}, r"vehicles.0.routes: needed by a vehicle with a goal"),
    ],
)
def test_wrong_settings(sections: dict[str, Any], message: str) -> None:
    with pytest.raises(ScenarioError, match=message):
        scenario(CHASE, **sections)


def test_a_route_without_a_sequel_is_refused() -> None:
    one = {"routes": ["south"], "motion": DRIVEN}
    with pytest.raises(ScenarioError, match=r"within 0.5 m of the end of route 'far'"):
        scenario([one], routes=SQUARE, termination={"after_arrival": "continue"})
    with pytest.raises(ScenarioError, match=r"vehicles.0.next_routes: unknown route 'sout' \(did you mean 'south'\?\)"):
        scenario([{**one, "next_routes": ["sout"]}], routes=SQUARE)
