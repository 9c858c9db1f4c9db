"""Prescribed motions, compiled into held body twists whose poses are exact.

Every prescribed motion becomes a table of segments: from its start time on, a body twist (v, omega) is held. The
pose at any time is then a closed form, so truth does not drift and any instant can be evaluated on its own.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from coopenv.scenario.bodies import ConstantMotion, SegmentMotion, WaypointMotion

SPLINE_STEP = 0.02
"""s between the poses at which a waypoint spline is met exactly ..."""
MOST_ROWS = 200
"""... but at most so many from one waypoint to the next, so that the table grows with the waypoints and not with time.
From pose to pose the path is an arc, which strays from the cubic by less than half of its length."""

STANDING = 1e-3  # m/s below which a spline's heading is held


@dataclass(frozen=True)
class TwistTable:
    """S segments; poses are relative to the agent's start."""

    start: np.ndarray  # (S,) s
    linear: np.ndarray  # (S, 3) m/s, body frame
    angular: np.ndarray  # (S, 3) rad/s, body frame
    rotation: np.ndarray  # (S, 3, 3) pose at the segment's start, relative to the agent's first pose
    position: np.ndarray  # (S, 3) m


def left_jacobian(w: np.ndarray) -> np.ndarray:
    """Return J_l(w) = int_0^1 Exp(s w) ds, (..., 3, 3), for rotation vectors w (..., 3) in rad."""
    angle = np.linalg.norm(w, axis=-1)[..., None, None]
    S = np.cross(np.eye(3), w[..., None, :])
    small, safe = angle < 1e-4, np.maximum(angle, 1e-4)
    first = np.where(small, 1 / 2, (1 - np.cos(safe)) / safe**2)
    second = np.where(small, 1 / 6, (safe - np.sin(safe)) / safe**3)
    return np.asarray(np.eye(3) + first * S + second * S @ S)


def twist_table(start: np.ndarray, linear: np.ndarray, angular: np.ndarray) -> TwistTable:
    """Chain held twists; segment i lasts from start[i] to start[i + 1], the last for ever."""
    count = len(start)
    rotation = np.tile(np.eye(3), (count, 1, 1))
    position = np.zeros((count, 3))
    for i in range(count - 1):
        h = start[i + 1] - start[i]
        position[i + 1] = position[i] + rotation[i] @ left_jacobian(angular[i] * h) @ linear[i] * h
        rotation[i + 1] = rotation[i] @ Rotation.from_rotvec(angular[i] * h).as_matrix()
    return TwistTable(start, linear, angular, rotation, position)


def compile_motion(motion: object, initial_rotation: np.ndarray, until: float) -> TwistTable:
    """Return the twist table of a motion of `coopenv.scenario.bodies` up to a time in s; driven agents stand in it.

    Its poses are in the frame of the agent's start, which `initial_rotation` (3, 3) turns to the map.
    """
    if isinstance(motion, WaypointMotion):
        return _spline_table(motion, initial_rotation, until)
    if isinstance(motion, ConstantMotion):
        return twist_table(np.zeros(1), np.array([motion.linear]), np.array([motion.angular]))
    segments = motion.segments if isinstance(motion, SegmentMotion) else ()
    start = np.array([0.0, *np.cumsum([segment.duration for segment in segments])])
    rest, begun = (0.0, 0.0, 0.0), start <= until
    linear = np.array([*(segment.linear for segment in segments), rest])
    angular = np.array([*(segment.angular for segment in segments), rest])
    return twist_table(start[begun], linear[begun], angular[begun])


def path_heading(motion: WaypointMotion) -> float:
    """Return the heading at which a waypoint motion sets off, rad."""
    _, _, heading = _sample_spline(motion, np.inf)
    return float(heading[0])


def _sample_times(times: np.ndarray, until: float) -> np.ndarray:
    """Return the times (S,) of the waypoints that count and between them, s."""
    times = np.minimum(times[: np.searchsorted(times, until) + 1], until)
    gaps = np.diff(times)
    counts = np.clip(np.ceil(gaps / SPLINE_STEP), 1, MOST_ROWS).astype(int)
    steps = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    return np.append(np.repeat(times[:-1], counts) + steps * np.repeat(gaps / counts, counts), times[-1])


def _sample_spline(motion: WaypointMotion, until: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return times (S,), positions (S, 3) and continuous headings (S,) along the spline."""
    from scipy.interpolate import PchipInterpolator  # here, as loading it takes 0.2 s

    times = np.array([w.time for w in motion.waypoints])
    # Shape preserving: between two equal waypoints the agent stands still instead of swinging.
    spline = PchipInterpolator(times, np.array([w.position for w in motion.waypoints]))
    t = _sample_times(times, until)
    velocity = spline(t, 1)[:, :2]
    moving = np.linalg.norm(velocity, axis=1) > STANDING
    if not moving.any():
        return t, spline(t), np.zeros(len(t))
    heading = np.unwrap(np.arctan2(velocity[moving, 1], velocity[moving, 0]))
    nearest = np.clip(np.cumsum(moving) - 1, 0, None)  # standing still keeps the last heading driven
    return t, spline(t), heading[nearest]


def _spline_table(motion: WaypointMotion, initial_rotation: np.ndarray, until: float) -> TwistTable:
    t, position, heading = _sample_spline(motion, until)
    angle = heading - heading[0] if motion.heading == "path" else np.zeros(len(t))
    rotation = Rotation.from_rotvec(np.outer(angle, [0.0, 0.0, 1.0])).as_matrix()
    relative = (position - position[0]) @ initial_rotation
    h = np.diff(t)[:, None]
    turn = np.outer(np.diff(angle), [0.0, 0.0, 1.0])
    step = np.diff(relative, axis=0)[:, None] @ rotation[:-1]
    linear = np.linalg.solve(left_jacobian(turn), np.swapaxes(step, 1, 2))[..., 0]
    rest = np.zeros((1, 3))
    return TwistTable(t, np.vstack([linear / h, rest]), np.vstack([turn / h, rest]), rotation, relative)
