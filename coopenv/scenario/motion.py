"""Prescribed motions, compiled into held body twists whose poses are exact.

Every prescribed motion becomes a table of segments: from its start time on, a body twist (v, omega) is held. The
pose at any time is then a closed form, so truth does not drift and any instant can be evaluated on its own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation

from coopenv.scenario.bodies import ConstantMotion, SegmentMotion, WaypointMotion

SPLINE_STEP = 0.02
"""s between the poses at which a waypoint spline is met exactly."""

STANDING = 1e-3
"""m/s below which a spline's heading is held."""


@dataclass(frozen=True)
class TwistTable:
    """S segments; poses are relative to the agent's start."""

    start: np.ndarray  # (S,) s
    linear: np.ndarray  # (S, 3) m/s, body frame
    angular: np.ndarray  # (S, 3) rad/s, body frame
    rotation: np.ndarray  # (S, 3, 3) pose at the segment's start, relative to the agent's first pose
    position: np.ndarray  # (S, 3) m


def left_jacobian(w: np.ndarray) -> np.ndarray:
    """Return J_l(w) = int_0^1 Exp(s w) ds, (3, 3), for a rotation vector w in rad."""
    angle = float(np.linalg.norm(w))
    S = np.cross(np.eye(3), w)
    if angle < 1e-4:
        return np.eye(3) + S / 2 + S @ S / 6
    result: np.ndarray = np.eye(3) + (1 - np.cos(angle)) / angle**2 * S + (angle - np.sin(angle)) / angle**3 * S @ S
    return result


def twist_table(start: list[float], linear: np.ndarray, angular: np.ndarray) -> TwistTable:
    """Chain held twists; segment i lasts from start[i] to start[i + 1], the last for ever."""
    count = len(start)
    rotation = np.tile(np.eye(3), (count, 1, 1))
    position = np.zeros((count, 3))
    for i in range(count - 1):
        h = start[i + 1] - start[i]
        position[i + 1] = position[i] + rotation[i] @ left_jacobian(angular[i] * h) @ linear[i] * h
        rotation[i + 1] = rotation[i] @ Rotation.from_rotvec(angular[i] * h).as_matrix()
    return TwistTable(np.asarray(start, dtype=float), linear, angular, rotation, position)


def standing() -> TwistTable:
    """Return the table of an agent that does not move by itself."""
    return twist_table([0.0], np.zeros((1, 3)), np.zeros((1, 3)))


def compile_motion(motion: object, initial_rotation: np.ndarray) -> TwistTable:
    """Return the twist table of a motion; static and driven agents stand still in it."""
    if isinstance(motion, ConstantMotion):
        return twist_table([0.0], np.array([motion.linear]), np.array([motion.angular]))
    if isinstance(motion, SegmentMotion):
        durations = [segment.duration for segment in motion.segments]
        start = [0.0, *np.cumsum(durations).tolist()]
        linear = np.array([segment.linear for segment in motion.segments] + [(0.0, 0.0, 0.0)])
        angular = np.array([segment.angular for segment in motion.segments] + [(0.0, 0.0, 0.0)])
        return twist_table(start, linear, angular)
    if isinstance(motion, WaypointMotion):
        return _spline_table(motion, initial_rotation)
    return standing()


def path_heading(motion: WaypointMotion) -> float:
    """Return the heading at which a waypoint motion sets off, rad."""
    _, _, heading = _sample_spline(motion)
    return float(heading[0])


def _sample_spline(motion: WaypointMotion) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return times (S,), positions (S, 3) and continuous headings (S,) along the spline."""
    times = np.array([w.time for w in motion.waypoints])
    # Shape preserving: between two equal waypoints the agent stands still instead of swinging.
    spline = PchipInterpolator(times, np.array([w.position for w in motion.waypoints]))
    t = np.linspace(0.0, times[-1], max(2, round(times[-1] / SPLINE_STEP) + 1))
    velocity = spline(t, 1)[:, :2]
    moving = np.linalg.norm(velocity, axis=1) > STANDING
    if not moving.any():
        return t, spline(t), np.zeros(len(t))
    heading = np.unwrap(np.arctan2(velocity[moving, 1], velocity[moving, 0]))
    nearest = np.clip(np.cumsum(moving) - 1, 0, None)  # standing still keeps the last heading driven
    return t, spline(t), heading[nearest]


def _spline_table(motion: WaypointMotion, initial_rotation: np.ndarray) -> TwistTable:
    t, position, heading = _sample_spline(motion)
    if motion.heading == "path":
        rotations = Rotation.from_rotvec(np.outer(heading, [0.0, 0.0, 1.0]))
    else:
        rotations = Rotation.from_matrix(np.tile(initial_rotation, (len(t), 1, 1)))
    h = np.diff(t)
    turn = (rotations[:-1].inv() * rotations[1:]).as_rotvec()
    step = rotations[:-1].inv().apply(np.diff(position, axis=0))
    linear = np.array([np.linalg.solve(left_jacobian(w), s) for w, s in zip(turn, step, strict=True)])
    rest = np.zeros((1, 3))
    return twist_table(t.tolist(), np.vstack([linear / h[:, None], rest]), np.vstack([turn / h[:, None], rest]))
