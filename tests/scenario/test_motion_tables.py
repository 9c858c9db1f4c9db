"""Motion tables: held twists whose poses chain without gaps, from segments and from splines."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation

from coopenv.scenario.bodies import ConstantMotion, SegmentMotion, StaticMotion, TwistSegment, Waypoint, WaypointMotion
from coopenv.scenario.routes import TwistTable, compile_motion, left_jacobian, path_heading
from tests.oracles import continuous

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
def test_what_comes_later_is_left_out(until: float) -> None:
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
