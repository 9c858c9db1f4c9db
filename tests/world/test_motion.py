"""Prescribed motions as the world plays them; contact of boxes, what ends an episode, and arrival."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from coopenv.estimation import Outcome
from coopenv.scenario.difficulty import FASTEST_PACE
from coopenv.scenario.routes import Boxes
from coopenv.world import dynamics
from coopenv.world.build import _motion
from coopenv.world.model import PRESCRIBED, STATIC
from tests.helpers.builders import command, constant, landmark, reset, run, scenario, start, vehicle
from tests.helpers.warp_calls import DTYPES, Calls
from tests.scenario.test_routes import depth as overlap

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


call = Calls(__name__, {dynamics.boxes_touch: "3 33 3 3 33 3 > b"})


def test_upright_boxes_against_a_linear_programme() -> None:
    rng = np.random.default_rng(0)
    count = 750
    ca, cb = rng.uniform(-1.5, 1.5, (2, count, 3)) * [1, 1, 0.7]
    yaw = rng.uniform(-np.pi, np.pi, (2, count))
    yaw[:, :200] = np.pi / 2 * rng.integers(0, 4, (2, 200))  # parallel faces
    Ra, Rb = (Rotation.from_euler("z", y[:, None]).as_matrix() for y in yaw)
    ha, hb = rng.uniform(0.05, 1.2, (2, count, 3))
    depth = np.array([overlap(Boxes(ca, Ra, ha), Boxes(cb, Rb, hb), n) for n in range(count)])
    clear = np.abs(depth) > 1e-5
    for dtype in DTYPES:
        touching = call(dynamics.boxes_touch, dtype, ca, Ra, ha, cb, Rb, hb)
        swapped = call(dynamics.boxes_touch, dtype, cb, Rb, hb, ca, Ra, ha)
        np.testing.assert_array_equal(touching[clear], (depth > 0)[clear])
        np.testing.assert_array_equal(swapped, touching)
        assert 0.2 < touching.mean() < 0.8


BODY = {"size": [1.0, 0.5, 0.4], "center": [0.3, 0.0, 0.2]}


def cars(*places: tuple[float, float, float], **sections: Any) -> Any:
    """Return standing vehicles with the same body at (x, y, yaw)."""
    return scenario([vehicle((x, y, 0.0), yaw, body=BODY) for x, y, yaw in places], **sections)


@pytest.mark.parametrize(
    ("place", "expected"),
    [
        ((0.99, 0.0, 0.0), 1),
        ((1.01, 0.0, 0.0), 0),
        ((0.0, 0.51, 0.0), 0),
        ((0.0, 0.49, 0.0), 1),
        ((1.59, 0.0, np.pi), 1),  # nose to nose: each body reaches 0.8 m ahead of its origin
        ((1.61, 0.0, np.pi), 0),
        ((1.04, -0.79, np.pi / 2), 1),
        ((1.06, -0.79, np.pi / 2), 0),
    ],
)
def test_contact_of_two_cars(place: tuple[float, float, float], expected: int) -> None:
    state = start(cars((0.0, 0.0, 0.0), place)).get_state()
    assert state["collided"][0].tolist() == [expected, expected]


def test_heights_count() -> None:
    low = vehicle((0, 0, 0), body=BODY)
    over = [vehicle((0.1, 0, z), body=BODY) for z in (0.39, 0.41)]
    assert [int(start(scenario([low, v])).get_state()["collided"][0, 0]) for v in over] == [1, 0]


def test_contact_with_buildings_and_bodies_of_landmarks() -> None:
    wall = {"name": "wall", "center": [2.0, 0.0, 0.5], "size": [1.0, 4.0, 1.0], "yaw": 0.0}
    post = landmark("post", (0.0, 3.0, 0.0), body={"size": [0.2, 0.2, 2.0]})
    bare = landmark("bare", (0.0, -3.0, 0.0))
    for place, expected in (  # moved there after the start, which may not be inside of a building
        ((0.69, 0, 0), 0),
        ((0.71, 0, 0), 1),
        ((-0.91, 3, 0), 0),
        ((-0.89, 3, 0), 1),
        ((0, -3, 0), 0),
    ):
        world = start(cars((-5.0, 0.0, 0.0), obstacles=[wall], landmarks=[post, bare]))
        state = world.get_state()
        state["position"][0, -1] = place
        state["start_position"][0, -1] = place
        world.set_state(state)
        world.advance(1)
        assert world.get_state()["collided"][0, 0] == expected, place


def test_vehicles_without_a_body_touch_nothing() -> None:
    state = start(scenario([vehicle((0, 0, 0)), vehicle((0.1, 0, 0), body=BODY)])).get_state()
    assert state["collided"][0].tolist() == [0, 0]


def crash(**termination: bool) -> list[dict[str, np.ndarray]]:
    """Return a second in which vehicle 1 runs at 2 m/s through vehicle 2, from 2 m away; vehicle 3 stands aside."""
    made = scenario(
        [
            vehicle((0, 0, 0), body=BODY, motion=constant([2.0, 0, 0])),
            vehicle((2, 0, 0), body=BODY),
            vehicle((0, 9, 0), body=BODY),
        ],
        termination=termination,
    )
    return run(start(made), 120)


def test_a_collision_ends_both_episodes_for_good() -> None:
    states = crash()
    touching = np.array([s["collided"][0] for s in states])
    ended = np.array([s["ended"][0] for s in states])
    expected = np.abs(2.0 - 2.0 * np.arange(121) / 60) <= 1.0 + 1e-9
    border = np.isclose(np.abs(2.0 - 2.0 * np.arange(121) / 60), 1.0)
    np.testing.assert_array_equal(touching[~border, 0], expected[~border])
    np.testing.assert_array_equal(touching[:, 1], touching[:, 0])
    first = int(np.argmax(touching[:, 0]))
    assert (ended[:first] == Outcome.UNDER_WAY).all()
    assert (ended[first:, :2] == Outcome.COLLIDED).all()
    assert (ended[:, 2] == Outcome.UNDER_WAY).all()


def test_collisions_may_be_tolerated() -> None:
    states = crash(collision=False)
    assert any(s["collided"][0, 0] for s in states)
    assert all((s["ended"][0] == Outcome.UNDER_WAY).all() for s in states)


@pytest.mark.parametrize("arrival", [True, False])
def test_arrival_is_by_horizontal_distance(arrival: bool) -> None:
    """The goal hangs 5 m above the road."""
    made = scenario(
        [vehicle((0, 0, 0), motion=constant([1.0, 0, 0]), goal={"position": [2.01, 0.3, 5], "radius": 0.5})],
        termination={"arrival": arrival},
    )
    ended = np.array([s["ended"][0, 0] for s in run(start(made), 180)])
    inside = np.hypot(2.01 - np.arange(181) / 60, 0.3) < 0.5
    first = int(np.argmax(inside))
    assert first == 97
    np.testing.assert_array_equal(
        ended, (np.arange(181) >= first) * (Outcome.ARRIVED if arrival else Outcome.UNDER_WAY)
    )


def test_a_goal_in_a_wall_is_a_collision() -> None:
    wall = {"name": "wall", "center": [2.0, 0.0, 0.2], "size": [1.0, 4.0, 1.0]}
    car = vehicle((0, 0, 0), body=BODY, motion=constant([1.0, 0, 0]), goal={"position": [2, 0, 0], "radius": 1.5})
    ended = [int(s["ended"][0, 0]) for s in run(start(scenario([car], obstacles=[wall])), 60)]
    near = vehicle((0, 0, 0), body=BODY, motion=constant([1.0, 0, 0]), goal={"position": [2, 0, 0], "radius": 1.29})
    late = [int(s["ended"][0, 0]) for s in run(start(scenario([near], obstacles=[wall])), 60)]
    assert ended[-1] == Outcome.ARRIVED
    assert late[-1] == Outcome.COLLIDED


def test_reset_clears_the_end() -> None:
    made = scenario([vehicle((0, 0, 0), motion={"kind": "driven"}, goal={"position": [0.3, 0, 0], "radius": 0.1})])
    world = start(made)
    command(world, [1.0, 0.0])
    world.advance(120)
    assert world.get_state()["ended"][0, 0] == Outcome.ARRIVED
    reset(world)
    assert world.get_state()["ended"][0, 0] == Outcome.UNDER_WAY
    world.advance(120)
    assert world.get_state()["ended"][0, 0] == Outcome.ARRIVED


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
