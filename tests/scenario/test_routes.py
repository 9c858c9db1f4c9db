"""Routes and motion tables: lines, arcs, segments and splines against closed forms."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.interpolate import PchipInterpolator
from scipy.optimize import linprog
from scipy.spatial.transform import Rotation

from coopenv import ScenarioError
from coopenv.scenario.bodies import ConstantMotion, SegmentMotion, StaticMotion, TwistSegment, Waypoint, WaypointMotion
from coopenv.scenario.routes import (
    BLOCK,
    MOST_POINTS,
    Boxes,
    Route,
    TwistTable,
    boxes_overlap,
    compile_motion,
    even_points,
    left_jacobian,
    overlapping_pairs,
    path_heading,
    point_count,
    possible_boxes,
    route_length,
    route_points,
)
from tests.helpers.builders import scenario, vehicle
from tests.oracles import continuous

LEFT_TURN = {"name": "left", "waypoints": [[-6.0, -0.5], [0.5, -0.5], [0.5, 7.0]], "corner_radius": 2.0}
DRIVEN = {"kind": "driven"}


def route(**values: Any) -> Route:
    return Route.model_validate({**LEFT_TURN, **values})


def test_a_corner_is_an_arc() -> None:
    made = route()
    assert route_length(made) == pytest.approx(4.5 + np.pi + 5.5)
    s = np.linspace(0.0, 4.5 + np.pi + 5.5, 101)
    x, y, heading = route_points(made, s).T
    on_arc = (s > 4.5) & (s < 4.5 + np.pi)
    angle = (s - 4.5) / 2.0
    np.testing.assert_allclose(x, np.where(on_arc, -1.5 + 2 * np.sin(angle), np.minimum(-6 + s, 0.5)), atol=1e-12)
    late = np.maximum(-0.5, 1.5 + s - 4.5 - np.pi)
    np.testing.assert_allclose(y, np.where(on_arc, 1.5 - 2 * np.cos(angle), late), atol=1e-12)
    np.testing.assert_allclose(heading, np.clip(angle, 0.0, np.pi / 2), atol=1e-12)


@given(
    turn=st.floats(-2.8, 2.8).filter(lambda angle: abs(angle) > 1e-3),
    radius=st.floats(0.0, 1.5),
    heading=st.floats(-3.0, 3.0),
)
@settings(max_examples=50, deadline=None)
def test_a_route_is_smooth_and_of_its_stated_length(turn: float, radius: float, heading: float) -> None:
    """By the chords of a fine division; headings are those of the chords."""
    legs = 10.0 * np.array([[np.cos(a), np.sin(a)] for a in (heading, heading + turn)])
    waypoints = np.vstack([np.zeros(2), np.cumsum(legs, axis=0)])
    made = route(waypoints=waypoints.tolist(), corner_radius=radius if np.tan(abs(turn) / 2) * radius < 10 else 0.0)
    length = route_length(made)
    points = route_points(made, np.linspace(0.0, length, 4001))
    step = np.diff(points[:, :2], axis=0)
    assert np.linalg.norm(step, axis=1).sum() == pytest.approx(length, rel=1e-3)
    np.testing.assert_allclose(points[[0, -1], :2], waypoints[[0, 2]], atol=1e-9)
    if made.corner_radius > 0.1:
        ahead = np.exp(1j * points[:-1, 2]) + np.exp(1j * points[1:, 2])
        chord = step @ [1, 1j]
        np.testing.assert_allclose(ahead / np.abs(ahead), chord / np.abs(chord), atol=5e-3 / radius)


def test_points_are_at_even_arc_length_and_few() -> None:
    assert point_count(route(waypoints=[[0, 0], [100, 0]])) == 2
    assert point_count(route(waypoints=[[0, 0], [4, 0]], wander=0.1)) == 17
    long = route(waypoints=[[0, 0], [500, 0], [500, 500]], corner_radius=100)
    assert point_count(long) == MOST_POINTS
    steps = np.linalg.norm(np.diff(even_points(route())[:, :2], axis=0), axis=1)
    assert steps.max() < 0.25
    np.testing.assert_allclose(steps, steps.max(), rtol=2e-3)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"corner_radius": 7.0}, r"routes.0.corner_radius: 7 m is too large for the corner at waypoints.1"),
        ({"waypoints": [[0, 0], [0, 0]]}, r"routes.0.waypoints.1: the same place as the waypoint before"),
        ({"waypoints": [[0, 0], [5, 0], [1, 0]]}, r"routes.0.waypoints.1: the route turns back on itself there"),
        ({"waypoints": [[0, 0]]}, r"routes.0.waypoints: too few entries, number 2 is missing|at least 2"),
        ({"lateral_spread": 1.5, "wander": 0.5}, r"routes.0.corner_radius: 2 m must be above lateral_spread \+ wander"),
        ({"start_spread": 14.0}, r"routes.0.start_spread: 14 m must be below the route's length \(13.1416 m\)"),
        ({"name": "1 st"}, r"routes.0.name"),
        ({"wonder": 0.1}, r"routes.0.wonder: unknown key \(did you mean 'wander'\?\)"),
    ],
)
def test_impossible_routes(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(ScenarioError, match=message):
        scenario([{"routes": ["left"], "motion": DRIVEN}], routes=[{**LEFT_TURN, **wrong}])


@pytest.mark.parametrize(
    ("car", "message"),
    [
        ({"routes": ["lift"], "motion": DRIVEN}, r"vehicles.0.routes: unknown route 'lift' \(did you mean 'left'\?\)"),
        ({"routes": ["left"]}, r"vehicles.0.routes: for driven vehicles and traffic; the motion of this one is"),
        (vehicle(routes=["left"], motion=DRIVEN), r"vehicles.0.initial_pose.position: .* starts on its route"),
        ({"routes": ["left"], "motion": DRIVEN, "goal": {"position": [0, 0, 0]}}, r"vehicles.0.goal.position: .*"),
        ({"motion": DRIVEN, "initial_pose": {"yaw": 1.0}}, r"vehicles.0.initial_pose.position: needed by a vehicle"),
        (vehicle(goal={"radius": 1.0}), r"vehicles.0.goal.position: needed by a vehicle without routes"),
        ({"motion": DRIVEN}, r"vehicles.0.initial_pose: needed, with at least a position"),
    ],
)
def test_vehicles_that_do_not_fit_their_routes(car: dict[str, Any], message: str) -> None:
    with pytest.raises(ScenarioError, match=message):
        scenario([car], routes=[LEFT_TURN])


def test_names_of_routes_are_free() -> None:
    with pytest.raises(ScenarioError, match="routes: the name 'left' is used twice"):
        scenario(**{"routes": [LEFT_TURN, LEFT_TURN]})


def test_a_route_must_not_begin_in_a_building() -> None:
    wall = {"name": "wall", "center": [-5.0, 0.7, 0.5], "size": [2.0, 1.0, 1.0]}
    body = {"size": [0.5, 0.3, 0.3]}
    car = {"routes": ["left"], "motion": DRIVEN, "body": body}
    scenario([car], routes=[LEFT_TURN], obstacles=[wall])
    for spread in ({"lateral_spread": 0.6}, {"lateral_spread": 0.6, "start_spread": 1.0}):
        with pytest.raises(ScenarioError, match="vehicle_1 starts inside obstacle 'wall'"):
            scenario([car], routes=[{**LEFT_TURN, **spread}], obstacles=[wall])


def test_the_boxes_of_a_start_are_at_every_corner_of_its_spread() -> None:
    """Each corner alone, by SciPy's rotations, from routes that begin straight."""
    pose, body = (
        {"position_spread": [0.2, 0.1, 0.05], "yaw_spread": 0.3},
        {"size": [0.5, 0.3, 0.2], "center": [0.1, 0, 0]},
    )
    right = {"name": "right", "waypoints": [[3.0, 4.0], [3.0, 9.0]]}
    routes = [{**LEFT_TURN, "lateral_spread": 0.6, "start_spread": 1.0}, right]
    made = scenario(
        [{"routes": ["left", "right"], "motion": DRIVEN, "initial_pose": pose, "body": body}], routes=routes
    )
    boxes = possible_boxes(made.vehicles[0], {r.name: r for r in made.routes})
    begins = [(-6.0 + s, -0.5 + aside, 0.0) for s in (0.0, 1.0) for aside in (0.0, 0.6, -0.6)] + [(3.0, 4.0, np.pi / 2)]
    expected = []
    for (x, y, heading), signs in product(begins, [(0, 0, 0, 0), *product((-1, 1), repeat=4)]):
        outer = Rotation.from_rotvec([0.0, 0.0, heading])
        turned = outer * Rotation.from_rotvec([0.0, 0.0, 0.3 * signs[3]])
        place = outer.apply(np.multiply(signs[:3], [0.2, 0.1, 0.05])) + turned.apply([0.1, 0.0, 0.0]) + [x, y, 0.0]
        expected.append(np.concatenate([place, turned.as_matrix().ravel(), [0.25, 0.15, 0.1]]))
    found = np.column_stack([boxes.center, boxes.rotation.reshape(-1, 9), boxes.half])
    assert_allclose(found[0, :3], [-5.9, -0.5, 0.0], atol=1e-12)  # the nominal start is the first
    assert len(found) == len(expected)
    distance = np.abs(found[:, None] - np.array(expected)).max(axis=-1)
    assert distance.min(axis=0).max() < 1e-12
    assert distance.min(axis=1).max() < 1e-12


# Boxes overlap where a linear programme finds a point in both


def drawn_boxes(rng: np.random.Generator, count: int, spread: float) -> Boxes:
    rotation = Rotation.random(count, random_state=rng.integers(2**31)).as_matrix()
    rotation[: count // 3] = np.eye(3)  # parallel edges
    return Boxes(rng.normal(0, spread, (count, 3)), rotation, rng.uniform(0.1, 2.0, (count, 3)))


def depth(a: Boxes, b: Boxes, n: int) -> float:
    """Return by how much the boxes would have to shrink on all sides to touch only; negative: to grow."""
    A = np.vstack([side * box.rotation[n].T for box in (a, b) for side in (1, -1)])
    limit = np.concatenate(
        [box.half[n] + side * (box.rotation[n].T @ box.center[n]) for box in (a, b) for side in (1, -1)]
    )
    solved = linprog([0, 0, 0, -1], A_ub=np.column_stack([A, np.ones(12)]), b_ub=limit, bounds=(None, None))
    return float(solved.x[3])


def test_against_linear_programmes() -> None:
    rng = np.random.default_rng(0)
    a, b = drawn_boxes(rng, 300, 1.5), drawn_boxes(rng, 300, 1.5)
    found = boxes_overlap(a, b)
    for n in range(300):
        d = depth(a, b, n)
        assert found[n] == (d > 0) or abs(d) < 1e-9, n
    assert 50 < found.sum() < 250


def test_pairs_are_found_block_by_block() -> None:
    rng = np.random.default_rng(1)
    a, b = drawn_boxes(rng, 900, 20.0), drawn_boxes(rng, 700, 20.0)
    assert len(a.half) * len(b.half) > 3 * BLOCK
    pairs = np.concatenate([*overlapping_pairs(a, b)])
    expected = [
        (i, j)
        for i in range(900)
        for j in np.flatnonzero(boxes_overlap(Boxes(*(np.repeat(x[i : i + 1], 700, axis=0) for x in a)), b))
    ]
    assert [tuple(pair) for pair in pairs.tolist()] == expected
    assert len(expected) > 100
    own = np.concatenate([*overlapping_pairs(a, a)])
    copied = np.concatenate([*overlapping_pairs(a, Boxes(*(x.copy() for x in a)))])
    assert np.array_equal(own, copied[copied[:, 1] < copied[:, 0]])


def test_points_lie_in_boxes_or_not_and_never_in_one_another() -> None:
    point = Boxes(np.zeros((1, 3)), np.eye(3)[None], np.zeros((1, 3)))
    for x, inside in ((0.5, True), (1.5, False), (1.0, False)):
        box = Boxes(np.array([[x, 0.0, 0.0]]), Rotation.from_rotvec([[0.3, 0.0, 0.0]]).as_matrix(), np.ones((1, 3)))
        assert boxes_overlap(point, box).tolist() == [inside]
    assert not boxes_overlap(point, point).any()
    assert not any(map(len, overlapping_pairs(point, Boxes(*(x[:0] for x in point)))))


POINTS = [(0.0, (1.0, 2.0, 0.0)), (1.3, (2.5, 2.0, 0.3)), (2.0, (3.0, 3.5, 0.5)), (4.1, (1.0, 5.0, 0.0))]


def assert_chained(table: TwistTable, tolerance: float = 1e-12) -> None:
    """Each segment ends where the next begins."""
    assert_allclose(table.rotation[0], np.eye(3))
    assert_allclose(table.position[0], 0.0)
    for i in range(len(table.start) - 1):
        h = table.start[i + 1] - table.start[i]
        w, v = table.angular[i], table.linear[i]
        R = table.rotation[i] @ Rotation.from_rotvec(w * h).as_matrix()
        p = table.position[i] + table.rotation[i] @ continuous.left_jacobian(w * h) @ v * h
        assert_allclose(table.rotation[i + 1], R, atol=tolerance)
        assert_allclose(table.position[i + 1], p, atol=tolerance)


@pytest.mark.parametrize("size", [0.0, 1e-12, 1e-6, 0.99e-4, 1.01e-4, 1e-3, 0.1, 3.0])
def test_left_jacobian(size: float) -> None:
    w = size * np.array([0.36, -0.48, 0.8])
    assert_allclose(left_jacobian(w), continuous.left_jacobian(w), atol=2e-9)


def test_static_and_constant() -> None:
    still = compile_motion(StaticMotion(), np.eye(3), 9.0)
    assert not still.linear.any()
    assert not still.angular.any()
    table = compile_motion(ConstantMotion(linear=(1, 2, 3), angular=(4, 5, 6)), np.eye(3), 9.0)
    assert table.linear.tolist() == [[1, 2, 3]]
    assert table.angular.tolist() == [[4, 5, 6]]


def test_segments_chain_and_end_at_rest() -> None:
    segments = (
        TwistSegment(duration=0.5, linear=(1, 0, 0)),
        TwistSegment(duration=1.5, linear=(0.5, 0.1, 0), angular=(0.1, -0.2, 1.0)),
        TwistSegment(duration=0.25, angular=(0, 0, -3.0)),
    )
    table = compile_motion(SegmentMotion(segments=segments), np.eye(3), 9.0)
    assert table.start.tolist() == [0.0, 0.5, 2.0, 2.25]
    assert not table.linear[-1].any()
    assert not table.angular[-1].any()
    assert_chained(table)


def spline(heading: str = "path", points: list[tuple[float, tuple[float, float, float]]] = POINTS) -> WaypointMotion:
    return WaypointMotion(waypoints=tuple(Waypoint(time=t, position=p) for t, p in points), heading=heading)


@pytest.mark.parametrize("heading", ["path", "fixed"])
def test_splines_pass_their_waypoints(heading: str) -> None:
    motion = spline(heading)
    R0 = Rotation.from_euler("z", path_heading(motion)).as_matrix()
    table = compile_motion(motion, R0, 9.0)
    assert_chained(table, 1e-11)
    times, places = (np.array(x) for x in zip(*POINTS, strict=True))
    curve = PchipInterpolator(times, places)
    in_map = places[0] + table.position @ R0.T
    assert_allclose(in_map, curve(table.start), atol=1e-10)
    assert table.start[-1] == pytest.approx(4.1)
    assert np.diff(table.start).max() < 0.0201
    assert not table.linear[-1].any()
    facing = R0 @ table.rotation
    if heading == "fixed":
        assert_allclose(facing, np.broadcast_to(R0, facing.shape), atol=1e-12)
    else:
        velocity = curve(table.start, 1)[:, :2]
        assert_allclose(facing[:, :2, 0], velocity / np.linalg.norm(velocity, axis=1, keepdims=True), atol=1e-9)


def test_straight_waypoints_drive_straight() -> None:
    motion = spline(points=[(0.0, (0.0, 0.0, 0.0)), (1.0, (0.0, 1.0, 0.0)), (3.0, (0.0, 3.0, 0.0))])
    assert path_heading(motion) == pytest.approx(np.pi / 2)
    table = compile_motion(motion, Rotation.from_euler("z", np.pi / 2).as_matrix(), 9.0)
    assert_allclose(table.linear[:-1], np.broadcast_to([1.0, 0.0, 0.0], (len(table.start) - 1, 3)), atol=1e-9)
    assert_allclose(table.angular, 0.0, atol=1e-9)


def test_equal_waypoints_wait_in_the_heading_of_the_first_real_motion() -> None:
    """Below 1 mm/s there is no heading; the body waits in the direction in which it will set off."""
    points = [(0.0, (0.0, 0.0, 0.0)), (2.0, (0.0, 0.0, 0.0)), (4.0, (0.0, 1.0, 0.0)), (6.0, (2.0, 1.0, 0.0))]
    motion = spline(points=points)
    assert path_heading(motion) == pytest.approx(np.pi / 2, abs=0.1)
    table = compile_motion(motion, Rotation.from_euler("z", path_heading(motion)).as_matrix(), 9.0)
    waiting = table.start <= 2.0
    assert_allclose(table.position[waiting], 0.0, atol=1e-9)
    assert_allclose(table.rotation[waiting], np.broadcast_to(np.eye(3), (waiting.sum(), 3, 3)), atol=1e-9)


def test_never_moving_waypoints_stand() -> None:
    still = [(0.0, (1.0, 1.0, 0.0)), (1.0, (1.0, 1.0, 0.0))]
    table = compile_motion(spline(points=still), np.eye(3), 9.0)
    assert path_heading(spline(points=still)) == 0.0
    assert_allclose(table.position, 0.0, atol=1e-15)


def test_rising_straight_up_has_no_heading() -> None:
    """Only the horizontal velocity turns the body."""
    table = compile_motion(spline(points=[(0.0, (0, 0, 0)), (1.0, (0, 0, 2))]), np.eye(3), 9.0)
    assert_allclose(table.rotation, np.broadcast_to(np.eye(3), table.rotation.shape), atol=1e-12)
    assert_allclose(table.position[-1], [0, 0, 2], atol=1e-12)


def test_tables_grow_with_waypoints_and_not_with_time() -> None:
    """A motion of a year is as large as one of minutes, and its path strays from the curve no farther."""
    lengths = []
    for scale in (1e2, 1e4, 1e7):
        points = [(scale * t, tuple(5.0 * x for x in p)) for t, p in POINTS]
        motion = spline(points=points)
        R0 = Rotation.from_euler("z", path_heading(motion)).as_matrix()
        table = compile_motion(motion, R0, np.inf)
        assert_chained(table, 1e-9)
        lengths.append(len(table.start))
        assert np.isin([t for t, _ in points], table.start).all()
        curve = PchipInterpolator(*(np.array(x) for x in zip(*points, strict=True)))
        h = np.diff(table.start)[:, None] / 2
        half = left_jacobian(table.angular[:-1] * h) @ (table.linear[:-1] * h)[..., None]
        between = table.position[:-1] + (table.rotation[:-1] @ half)[..., 0]
        strayed = np.array(points[0][1]) + between @ R0.T - curve(table.start[:-1] + h[:, 0])
        length = np.linalg.norm(np.diff(table.position, axis=0), axis=1)
        assert (np.linalg.norm(strayed, axis=1) < 0.5 * length).all() and length.max() < 0.2
    assert lengths == [601, 601, 601]


@pytest.mark.parametrize("until", [0.5, 1.3, 2.05, 4.1, 5.0])
def test_waypoints_after_the_horizon_are_left_out(until: float) -> None:
    motion = spline()
    R0 = Rotation.from_euler("z", path_heading(motion)).as_matrix()
    cut, whole = compile_motion(motion, R0, until), compile_motion(motion, R0, 9.0)
    assert cut.start[-1] == min(until, 4.1)
    curve = PchipInterpolator(*(np.array(x) for x in zip(*POINTS, strict=True)))
    assert_allclose(POINTS[0][1] + cut.position @ R0.T, curve(cut.start), atol=1e-10)
    assert len(cut.start) <= len(whole.start)
    segments = tuple(TwistSegment(duration=d, linear=(1, 0, 0)) for d in (1.0, 1.0, 1e9, 1e9))
    held = compile_motion(SegmentMotion(segments=segments), np.eye(3), until)
    assert held.start.tolist() == [t for t in (0.0, 1.0, 2.0) if t <= until]
