"""Prescribed motions as the world plays them."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from coopenv.scenario.difficulty import FASTEST_PACE
from coopenv.world.build import _motion
from coopenv.world.model import PRESCRIBED, STATIC
from tests.helpers.builders import constant, landmark, run, scenario, start, vehicle
from tests.helpers.warp_calls import DTYPES

SEGMENTS = [
    {"duration": 0.5, "linear": [1.0, 0.0, 0.0]},
    {"duration": 0.7, "linear": [0.8, 0.1, 0.05], "angular": [0.0, 0.2, 1.5]},
    {"duration": 0.31},
    {"duration": 0.4, "linear": [-0.5, 0.0, 0.0], "angular": [0.0, 0.0, -3.0]},
]


def poses(states: list[dict[str, np.ndarray]], agent: int = -1) -> tuple[np.ndarray, np.ndarray]:
    """Return rotations (K, 3, 3) and positions (K, 3) of one agent of the first world."""
    return np.array([s["rotation"][0, agent] for s in states]), np.array([s["position"][0, agent] for s in states])


def integrated(motion: list[dict[str, Any]], R0: np.ndarray, p0: np.ndarray, times: np.ndarray) -> tuple[Any, Any]:
    """Integrate dR = R S(omega), dp = R v by an ODE solver, segment by segment."""
    state, R, p, now = np.concatenate([R0.ravel(), p0]), [], [], 0.0
    ends = np.append(np.cumsum([s["duration"] for s in motion]), np.inf)
    for segment, end in zip([*motion, {}], ends, strict=True):
        v, w = np.array(segment.get("linear", [0, 0, 0.0])), np.array(segment.get("angular", [0, 0, 0.0]))

        def rate(_: float, y: np.ndarray, v: np.ndarray = v, w: np.ndarray = w) -> np.ndarray:
            A = y[:9].reshape(3, 3)
            return np.concatenate([np.cross(A, w).ravel(), A @ v])  # rows of R S(w)

        inside = times[(times >= now) & (times < end)]
        last = min(end, max(times[-1], now) + 1e-9)
        grid = np.append(inside, last)
        y = solve_ivp(rate, (now, last), state, t_eval=grid, rtol=1e-11, atol=1e-12).y.T
        R += list(y[:-1, :9].reshape(-1, 3, 3))
        p += list(y[:-1, 9:])
        state, now = y[-1], end
        if now > times[-1]:
            break
    return np.array(R), np.array(p)


@pytest.mark.parametrize(("dtype", "tolerance"), [("float64", 1e-8), ("float32", 3e-6)])
def test_segments_against_an_ode_solver(dtype: str, tolerance: float) -> None:
    R0 = Rotation.from_euler("zyx", [0.7, 0.0, 0.0]).as_matrix()
    motion = {"kind": "segments", "segments": SEGMENTS}
    mark = landmark("A", (1, 2, 3), yaw=0.7, motion=motion)
    states = run(start(scenario([vehicle((1, 2, 3), 0.7, motion=motion)], landmarks=[mark]), 0, dtype), 150)
    expected_R, expected_p = integrated(SEGMENTS, R0, np.array([1.0, 2, 3]), np.arange(151) / 60)
    for agent in (0, -1):
        R, p = poses(states, agent)
        assert_allclose(R, expected_R, atol=tolerance)
        assert_allclose(p, expected_p, atol=tolerance)
    assert_allclose(p[-1], p[-20])  # stands still afterwards
    assert_allclose(states[-1]["velocity"][0, -1], 0)


def test_constant_twist_is_a_circle() -> None:
    """0.5 m/s and 0.4 rad/s: radius 1.25 m about the point to the left, for ten minutes without drift."""
    world = start(scenario([vehicle((3, -1, 0.5), 0.3, motion=constant([0.5, 0, 0], [0, 0, 0.4]))]))
    center = np.array([3 - 1.25 * np.sin(0.3), -1 + 1.25 * np.cos(0.3)])
    for _ in range(60):
        world.advance(600)
        state = world.get_state()
        t = state["tick"][0] / 60
        heading = 0.3 + 0.4 * t
        assert_allclose(
            state["position"][0, -1],
            [*(center + 1.25 * np.array([np.sin(heading), -np.cos(heading)])), 0.5],
            atol=1e-11,
        )
        assert_allclose(state["rotation"][0, -1], Rotation.from_euler("z", heading).as_matrix(), atol=1e-11)


def test_truth_does_not_depend_on_the_camera_rate() -> None:
    motion = {"kind": "segments", "segments": SEGMENTS}
    ends = []
    for rate in (10.0, 40.0, 70.0):
        made = scenario([vehicle((1, 2, 3), 0.7, motion=motion)], rates={"camera": rate, "decision": 10.0})
        R, p = poses(run(start(made), round(1.5 * rate)))
        ends.append(np.concatenate([R[-1].ravel(), p[-1]]))
    assert_allclose(ends[1], ends[0], atol=1e-13)
    assert_allclose(ends[2], ends[0], atol=1e-13)


WAYPOINTS = [
    {"time": 0.0, "position": [0.0, 0.0, 0.2]},
    {"time": 1.0, "position": [1.0, 0.4, 0.2]},
    {"time": 2.5, "position": [2.0, 2.0, 0.5]},
    {"time": 4.0, "position": [0.5, 3.0, 0.4]},
]


@pytest.mark.parametrize("heading", ["path", "fixed"])
def test_waypoints_are_passed_at_their_times(heading: str) -> None:
    made = scenario([{"motion": {"kind": "waypoints", "waypoints": WAYPOINTS, "heading": heading}}])
    states = run(start(made), 300)
    R, p = poses(states)
    for w in WAYPOINTS:
        assert_allclose(p[round(w["time"] * 60)], w["position"], atol=1e-4)
    assert_allclose(p[240:], np.broadcast_to(p[240], (61, 3)), atol=1e-12)
    step = (p[2:] - p[:-2])[:230] * 30
    forward = R[1:231, :, 0]
    if heading == "path":
        along = step[:, :2] / np.linalg.norm(step[:, :2], axis=1, keepdims=True)
        sideways = along[:, 0] * forward[:, 1] - along[:, 1] * forward[:, 0]
        assert np.abs(sideways).max() < 0.02
        assert ((along * forward[:, :2]).sum(axis=1) > 0.99).all()
    else:
        assert_allclose(R, np.broadcast_to(R[0], R.shape), atol=1e-12)
    assert_allclose(R[:, 2, 2], 1.0, atol=1e-12)  # upright
    turn = [Rotation.from_matrix(a.T @ b).magnitude() for a, b in pairwise(R)]
    assert max(turn) < 0.1
    assert np.abs(np.diff(p, n=2, axis=0))[:238].max() < 5e-3  # smooth: below 18 m/s^2


@pytest.mark.parametrize("dtype", DTYPES)
def test_velocity_is_the_derivative_of_the_pose(dtype: str) -> None:
    """Where a twist is held, Exp(w h) and J(w h) v h carry one tick to the next."""
    made = scenario([vehicle((1, 2, 3), 0.7, motion=constant([0.5, 0.2, 0.1], [0.3, -0.2, 0.9]))])
    states = run(start(made, 0, dtype), 60)
    R, p = poses(states)
    for k in range(60):
        w = states[k]["angular_velocity"][0, -1].astype(float)
        turn = Rotation.from_matrix(R[k].T.astype(float) @ R[k + 1]).as_rotvec()
        assert_allclose(turn * 60, w, atol=1e-10 if dtype == "float64" else 1e-4)
    middle = (p[2:] - p[:-2]).astype(float) * 30
    world_v = np.einsum("kij,kj->ki", R[1:-1], [s["velocity"][0, -1] for s in states[1:-1]])
    assert_allclose(middle, world_v, atol=1e-4)


@pytest.mark.parametrize(("spread", "pace"), [(0.0, 1.0), (0.1, 2.0 * FASTEST_PACE)])
def test_prepared_motions_last_one_frame_beyond_the_horizon(spread: float, pace: float) -> None:
    """A longer pace takes the motion's table farther; the frame beyond it is that of the last tick."""
    points = [{"time": float(t), "position": [0.1 * t, 0.0, 0.0]} for t in range(60)]
    moving = {"motion": {"kind": "waypoints", "waypoints": points}, "pace_spread": spread}
    segments = {"kind": "segments", "segments": [{"duration": 1.0, "linear": [n, 0.0, 0.0]} for n in range(9)]}
    walker = landmark("walker", (5.0, 5.0, 1.0), motion=segments)
    marks = [landmark(f"m{n}", (n, 9.0, 1.0)) for n in range(3)]
    made = scenario([moving], horizon=4.0, rates={"camera": 25.0, "decision": 5.0}, landmarks=[*marks, walker])
    found = _motion(made)
    until = (4.0 + 1.0 / 25.0) * pace
    assert found["kind"] == [STATIC] * 3 + [PRESCRIBED] * 2
    assert found["start"][-1] == pytest.approx(min(until, 59.0), abs=1e-12)
    begun = [float(t) for t in range(10) if t <= until]
    first, last = found["first"][3:5]
    assert found["start"][first:last].tolist() == begun
    assert found["linear"][first:last, 0].tolist() == [*(float(n) for n in range(9)), 0.0][: len(begun)]
