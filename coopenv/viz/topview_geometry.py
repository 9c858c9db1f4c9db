"""The geometry behind the top view: everything in plan (x east, y north), in the map frame, m."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from coopenv.estimation.lens import largest_radius, undistort
from coopenv.scenario import Scenario
from coopenv.scenario.bodies import Landmark, Vehicle
from coopenv.scenario.routes import TwistTable, compile_motion, even_points, left_jacobian
from coopenv.scenario.schema import agent_starts
from coopenv.scenario.sensing import Camera

SIGMAS = 3.0
_CIRCLE = np.linspace(0.0, 2 * np.pi, 97)
_ROUNDING = 1e-12  # of the largest eigenvalue: so far below zero is zero
_FAN_RAYS = 65
_PATH_SAMPLES = 121
_MARGIN = 0.05  # share of the scene around it


def semi_axes(covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the 3-sigma semi-axes of covariances (N, D, D): lengths (N, D), ascending, and axes (N, D, D).

    Axes are rotation matrices. Lengths are NaN where a matrix is not finite, or has a negative eigenvalue.
    """
    finite = np.isfinite(covariance).all(axis=(-1, -2))
    variance, axes = np.linalg.eigh(np.where(finite[:, None, None], covariance, 0.0))
    axes[..., 0] *= np.sign(np.linalg.det(axes))[:, None]
    valid = finite & (variance[:, 0] >= -_ROUNDING * variance[:, -1])
    return np.where(valid[:, None], SIGMAS * np.sqrt(np.maximum(variance, 0.0)), np.nan), axes


def ellipses(center: np.ndarray, covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return 3-sigma outlines (N, 97, 2) of covariances (N, 2, 2) and major semi-axes (N,); NaN where one is none."""
    semi, axes = semi_axes(covariance)
    circle = np.stack([np.cos(_CIRCLE), np.sin(_CIRCLE)])
    return center[:, None] + np.swapaxes((axes * semi[:, None]) @ circle, 1, 2), semi[:, 1]


def outlines(rotation: np.ndarray, position: np.ndarray, shape: np.ndarray) -> np.ndarray:
    """Return body-fixed outlines (N, K, 2) in plan, of rotations (N, 3, 3), places (N, 2), `shape` (N, K, 2)."""
    return np.asarray(position[:, None] + shape @ np.swapaxes(rotation[:, :2, :2], 1, 2))


def box_outlines(rotation: np.ndarray, center: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Return the corners (n, 4, 2) in plan of boxes of rotations (n, 3, 3), centres and half sizes (n, 3)."""
    corners = half[:, None, :2] * [(-1, -1), (1, -1), (1, 1), (-1, 1)]
    return np.asarray(center[:, None, :2] + corners @ np.swapaxes(rotation[:, :2, :2], 1, 2))


def box_shape(size: tuple[float, ...], center: tuple[float, ...], shortest: float) -> np.ndarray:
    """Return a box's four corners (4, 2) in the body frame, enlarged to at least `shortest` m long."""
    half = np.array(size[:2]) / 2
    corners = np.array(center[:2]) + half * [(-1, -1), (1, -1), (1, 1), (-1, 1)]
    return np.asarray(corners * max(1.0, shortest / (2 * half.max())))


def nose_shape(corners: np.ndarray) -> np.ndarray:
    """Return the triangle (3, 2) that marks the front of a box of four corners."""
    rear, front = corners.min(axis=0), corners.max(axis=0)
    waist = 0.42 * rear[0] + 0.58 * front[0]
    inset = 0.18 * (front[1] - rear[1])
    return np.array([(waist, rear[1] + inset), (front[0] - inset, (rear[1] + front[1]) / 2), (waist, front[1] - inset)])


def ways(scenario: Scenario) -> np.ndarray:
    """Return the angle (N,), rad, from each vehicle's x axis to its direction of travel at the start.

    In the paper's intersection bodies are not turned: R = I also of those that go north. There, where bodies hide
    nothing, a vehicle is drawn in its direction of travel; everywhere else the angle is zero.
    """
    if scenario.topology.mode != "fixed":
        return np.zeros(len(scenario.vehicles))
    starts = zip(scenario.vehicles, agent_starts(scenario)[1][len(scenario.landmarks) :], strict=True)
    still = ("static", "driven", "traffic")
    first = [
        np.zeros(3) if v.motion.kind in still else compile_motion(v.motion, R, scenario.horizon).linear[0]
        for v, R in starts
    ]
    return np.array([np.arctan2(velocity[1], velocity[0]) for velocity in first])


def turned(shapes: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Return shapes (N, K, 2) turned about the origin of their bodies by angles (N,), rad."""
    c, s = np.cos(angle), np.sin(angle)
    rotation = np.stack([np.stack([c, -s], axis=-1), np.stack([s, c], axis=-1)], axis=-2)
    return np.asarray(shapes @ np.swapaxes(rotation, 1, 2))


def camera_fan(camera: Camera) -> np.ndarray:
    """Return unit rays (K, 3) in the body frame over the width of the image, at the height of its centre."""
    edges = (np.array([0.0, camera.image_size[0]]) - camera.principal_point[0]) / camera.focal_length[0]
    imaged, has_ray = undistort(np.column_stack([edges, np.zeros(2)]), camera.distortion)
    widest = np.copysign(largest_radius(camera.distortion), edges)  # where the lens images nothing at the edge
    left, right = np.arctan(np.where(has_ray, imaged[:, 0], widest)).tolist()
    x = np.linspace(left, right, _FAN_RAYS)
    rays = np.stack([np.sin(x), np.zeros_like(x), np.cos(x)], axis=-1)
    return np.asarray(rays @ camera.to_body().T)


class Box(NamedTuple):
    """A box that occludes targets."""

    name: str
    rotation: np.ndarray  # (3, 3) to map
    center: np.ndarray  # (3,) map, m
    size: Any  # (3,) m


def crossings(start: np.ndarray, path: np.ndarray, boxes: Sequence[Box]) -> tuple[np.ndarray, np.ndarray]:
    """Return at which shares of straight paths boxes are entered and left, (B, K) each.

    A path misses a box where the first share is not below the second one.

    Args:
        start: (K, 3) map, m.
        path: (K, 3) from there to the ends, map, m.
        boxes: B of them, at least one.
    """
    turn, center = np.array([box.rotation for box in boxes]), np.array([box.center for box in boxes])
    half = np.array([box.size for box in boxes], float)[:, None] / 2
    a, along = (start - center[:, None]) @ turn, path @ turn
    along = np.where(np.abs(along) < 1e-12, 1e-12, along)
    one, other = (-half - a) / along, (half - a) / along
    return np.minimum(one, other).max(axis=-1), np.maximum(one, other).min(axis=-1)


def free_lengths(origin: np.ndarray, rays: np.ndarray, reach: np.ndarray | float, boxes: Sequence[Box]) -> np.ndarray:
    """Return how far rays (N, K, 3) from cameras (N, 3) get before a box stops them, (N, K) m, up to `reach`.

    `reach` is one for all, or (N,) of each camera. Rays are unit vectors in the map frame.
    """
    length = np.repeat(np.broadcast_to(np.asarray(reach, float), len(rays))[:, None], rays.shape[1], axis=1)
    if not boxes:
        return length
    enter, leave = crossings(np.repeat(origin, rays.shape[1], axis=0), rays.reshape(-1, 3), boxes)
    free = np.where((enter < leave) & (leave > 0), np.maximum(enter, 0.0), np.inf).min(axis=0)
    return np.asarray(np.minimum(length, free.reshape(length.shape)))


def about_z(angle: float) -> np.ndarray:
    """Return the rotation (3, 3) about z by an angle, rad."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([(c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0)])


def limits(scenario: Scenario) -> tuple[np.ndarray, np.ndarray]:
    """Return opposite corners (2,) of a square around all that is known of the episode beforehand, with a margin.

    Landmarks, roads, starts, prescribed motions over the horizon, and goals.
    """
    points = np.concatenate([*_places(scenario), *_paths(scenario)])
    low, high = points.min(axis=0), points.max(axis=0)
    half = (0.5 + _MARGIN) * max(1.0, float((high - low).max()))
    return (low + high) / 2 - half, (low + high) / 2 + half


def _places(scenario: Scenario) -> list[np.ndarray]:
    origin = np.array(scenario.map.origin)[:2]
    corners = np.array([(-1, -1), (1, 1)])
    goals = [(v.goal.position[:2], v.goal.radius) for v in scenario.vehicles if v.goal and v.goal.position]
    around = [np.array(place) - origin + radius * corners for place, radius in goals]
    followed = {name: vehicle.goal_radius for vehicle in scenario.vehicles for name in vehicle.routes}
    for route in scenario.routes:
        margin = followed.get(route.name, 0.0) + route.breadth
        around += [point - origin + margin * corners for point in even_points(route)[:, :2]]
    for group in scenario.landmark_groups:
        for corner, first, second in group.parallelograms:
            corner_of = np.array(corner) - origin
            around.append(np.array([corner_of, corner_of + first, corner_of + second]))
    return [*around, *(road_corners(road.start, road.end, road.width) - origin for road in scenario.roads)]


def _paths(scenario: Scenario) -> list[np.ndarray]:
    agents: list[Landmark | Vehicle] = [*scenario.landmarks, *scenario.vehicles]
    t = np.linspace(0.0, scenario.horizon, _PATH_SAMPLES)
    paths = []
    for agent, position, rotation in zip(agents, *agent_starts(scenario), strict=True):
        still = agent.motion.kind in ("static", "driven", "traffic")
        relative = _positions(compile_motion(agent.motion, rotation, scenario.horizon), t[:1] if still else t)
        paths.append((position + relative @ rotation.T)[:, :2])
    return paths


def _positions(table: TwistTable, t: np.ndarray) -> np.ndarray:
    """Return positions (K, 3) relative to the start at times (K,) s."""
    segment = np.searchsorted(table.start, t, side="right") - 1
    h = (t - table.start[segment])[:, None]
    step = left_jacobian(table.angular[segment] * h) @ (table.linear[segment] * h)[..., None]
    return np.asarray(table.position[segment] + (table.rotation[segment] @ step)[..., 0])


def road_corners(start: tuple[float, float], end: tuple[float, float], width: float) -> np.ndarray:
    """Return the corners (4, 2) of a road."""
    a, b = np.array(start), np.array(end)
    along = (b - a) / max(float(np.linalg.norm(b - a)), 1e-9)
    aside = np.array([-along[1], along[0]]) * width / 2
    return np.array([a - aside, b - aside, b + aside, a + aside])


def pointers(
    origin: np.ndarray, point: np.ndarray, low: np.ndarray, high: np.ndarray, size: float
) -> tuple[list[np.ndarray], list[int]]:
    """Return triangles (3, 2) at the border, pointing to each `point` (N, 2) outside the picture, and their indices.

    The pointing lines come from `origin` (N, 2), or from the picture's middle where that is outside too. `low` and
    `high` are corners of the picture, `size` is the length of a triangle, m.
    """
    triangles, which = [], []
    for i, (start, end) in enumerate(zip(origin, point, strict=True)):
        if not np.isfinite(end).all() or np.all((end >= low) & (end <= high)):
            continue
        if not np.all((start > low) & (start < high)):
            start = (low + high) / 2
        way = end - start
        room = np.where(way > 0, high - start, start - low)
        share = np.min(room / np.maximum(np.abs(way), 1e-9))
        ahead = way / np.linalg.norm(way)
        aside = np.array([-ahead[1], ahead[0]])
        tip = start + share * way - 0.15 * size * ahead
        base = tip - size * ahead
        triangles.append(np.array([tip, base + 0.45 * size * aside, base - 0.45 * size * aside]))
        which.append(i)
    return triangles, which
