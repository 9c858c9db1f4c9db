"""The static side of a picture of a world and its geometry: fields of view, occlusion, and everything in plan.

In plan x is east and y north; all is in the map frame, m.
"""

from collections.abc import Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from coopenv.episode import Frame, semi_axes
from coopenv.estimation import Sight
from coopenv.estimation.lens import largest_radius, undistort
from coopenv.scenario import Scenario
from coopenv.scenario.bodies import Body, Landmark, Vehicle
from coopenv.scenario.routes import compile_motion, even_points, left_jacobian
from coopenv.scenario.schema import agent_starts
from coopenv.scenario.sensing import Camera, rotation_of

_CIRCLE = np.linspace(0.0, 2 * np.pi, 97)
CORNERS = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
"""Corners of a square about the origin, in order."""
_FAN_RAYS = 65
_PATH_SAMPLES = 121
_UNKNOWN = ("static", "driven", "traffic")  # motions that say nothing of a way
_MARGIN = 0.05  # share of the scene around it


def ellipses(center: np.ndarray, covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return 3-sigma outlines (N, 97, 2) of covariances (N, 2, 2) and major semi-axes (N,); NaN where one is none."""
    semi, axes = semi_axes(covariance)
    circle = np.stack([np.cos(_CIRCLE), np.sin(_CIRCLE)])
    return center[:, None] + np.swapaxes((axes * semi[:, None]) @ circle, 1, 2), semi[:, 1]


def outlines(rotation: np.ndarray, position: np.ndarray, shape: np.ndarray) -> np.ndarray:
    """Return body-fixed outlines (N, K, 2) in plan, of rotations (N, 3, 3), places (N, 2), `shape` (N, K, 2)."""
    return np.asarray(position[:, None] + shape @ np.swapaxes(rotation[:, :2, :2], 1, 2))


def box_shapes(bodies: Sequence[Body], shortest: float) -> np.ndarray:
    """Return the corners (N, 4, 2) of boxes in the body frame, each enlarged to at least `shortest` m long."""
    size, center = (
        np.array([part[:2] for part in parts], float).reshape(-1, 1, 2)
        for parts in ((body.size for body in bodies), (body.center for body in bodies))
    )
    grown = np.maximum(1.0, shortest / size.max(axis=-1, keepdims=True))
    return np.asarray((center + size / 2 * CORNERS) * grown)


def nose_shapes(boxes: np.ndarray) -> np.ndarray:
    """Return the triangles (N, 3, 2) that mark the fronts of boxes of four corners (N, 4, 2)."""
    rear, front = boxes.min(axis=1), boxes.max(axis=1)
    waist = 0.42 * rear[:, 0] + 0.58 * front[:, 0]
    inset = 0.18 * (front[:, 1] - rear[:, 1])
    x = np.stack([waist, front[:, 0] - inset, waist], axis=-1)
    y = np.stack([rear[:, 1] + inset, (rear[:, 1] + front[:, 1]) / 2, front[:, 1] - inset], axis=-1)
    return np.stack([x, y], axis=-1)


def ways(scenario: Scenario) -> np.ndarray:
    """Return the angle (N,), rad, from each vehicle's x axis to its direction of travel at the start.

    In the paper's intersection bodies are not turned: R = I also of those that go north. There, where bodies hide
    nothing, a vehicle is drawn in its direction of travel; everywhere else the angle is zero.
    """
    if scenario.topology.mode != "fixed":
        return np.zeros(len(scenario.vehicles))
    starts = zip(scenario.vehicles, agent_starts(scenario)[1][len(scenario.landmarks) :], strict=True)
    first = [
        np.zeros(3) if v.motion.kind in _UNKNOWN else compile_motion(v.motion, R, scenario.horizon).linear[0]
        for v, R in starts
    ]
    return np.array([np.arctan2(velocity[1], velocity[0]) for velocity in first])


def camera_fan(camera: Camera) -> np.ndarray:
    """Return unit rays (K, 3) in the body frame over the width of the image, at the height of its centre."""
    edges = (np.array([0.0, camera.image_size[0]]) - camera.principal_point[0]) / camera.focal_length[0]
    imaged, has_ray = undistort(np.column_stack([edges, np.zeros(2)]), camera.distortion)
    widest = np.copysign(largest_radius(camera.distortion), edges)  # where the lens images nothing at the edge
    left, right = np.arctan(np.where(has_ray, imaged[:, 0], widest)).tolist()
    x = np.linspace(left, right, _FAN_RAYS)
    rays = np.stack([np.sin(x), np.zeros_like(x), np.cos(x)], axis=-1)
    return np.asarray(rays @ camera.to_body().T)


_SIGNS = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
_FACES = np.array([(0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 4, 6, 2), (1, 5, 7, 3)])


class Box(NamedTuple):
    """A box that occludes targets."""

    name: str
    rotation: np.ndarray  # (3, 3) to map
    center: np.ndarray  # (3,) map, m
    size: Any  # (3,) m
    agent: int = -1  # its index, landmarks first; -1: of none

    @property
    def faces(self) -> np.ndarray:
        """Return the corners (6, 4, 3) of its faces; the first two are across x, the last two across z."""
        corners = self.center + 0.5 * _SIGNS[_FACES] * np.asarray(self.size, float) @ self.rotation.T
        return np.asarray(corners)


def entries(start: np.ndarray, path: np.ndarray, boxes: Sequence[Box]) -> np.ndarray:
    """Return at which shares (B, K) of straight paths boxes are entered; 0: it starts inside, infinite: it misses it.

    Args:
        start: (K, 3) map, m.
        path: (K, 3) from there to the ends, map, m.
        boxes: B of them.
    """
    if not boxes:
        return np.empty((0, len(start)))
    turn, center = np.array([box.rotation for box in boxes]), np.array([box.center for box in boxes])
    half = np.array([box.size for box in boxes], float)[:, None] / 2
    a, along = (start - center[:, None]) @ turn, path @ turn
    along = np.where(np.abs(along) < 1e-12, 1e-12, along)
    one, other = (-half - a) / along, (half - a) / along
    enter, leave = np.minimum(one, other).max(axis=-1), np.maximum(one, other).min(axis=-1)
    return np.where((enter < leave) & (leave > 0.0), np.maximum(enter, 0.0), np.inf)


def free_lengths(origin: np.ndarray, rays: np.ndarray, reach: np.ndarray | float, boxes: Sequence[Box]) -> np.ndarray:
    """Return the lengths (N, K), m, of rays (N, K, 3) from cameras (N, 3) up to the first box or `reach`.

    `reach` is one for all, or (N,) of each camera. Rays are unit vectors in the map frame.
    """
    enter = entries(np.repeat(origin, rays.shape[1], axis=0), rays.reshape(-1, 3), boxes)
    free = enter.min(axis=0, initial=np.inf).reshape(rays.shape[:2])
    return np.asarray(np.minimum(free, np.reshape(reach, (-1, 1))))


def limits(scenario: Scenario) -> tuple[np.ndarray, np.ndarray]:
    """Return opposite corners (2,) of a square around all that is known of the episode beforehand, with a margin.

    Landmarks, roads, starts, prescribed motions over the horizon, and goals.
    """
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
            around.append(np.array([corner, np.add(corner, first), np.add(corner, second)]) - origin)
    points = np.concatenate([*around, *roads(scenario), *paths(scenario)])
    low, high = points.min(axis=0), points.max(axis=0)
    half = (0.5 + _MARGIN) * max(1.0, float((high - low).max()))
    return (low + high) / 2 - half, (low + high) / 2 + half


def paths(scenario: Scenario) -> list[np.ndarray]:
    """Return points (K, 2) along the prescribed motion of every agent, or its nominal start; landmarks first."""
    agents: list[Landmark | Vehicle] = [*scenario.landmarks, *scenario.vehicles]
    found = []
    for agent, position, rotation in zip(agents, *agent_starts(scenario), strict=True):
        table = compile_motion(agent.motion, rotation, scenario.horizon)
        t = np.linspace(0.0, scenario.horizon, 1 if agent.motion.kind in _UNKNOWN else _PATH_SAMPLES)
        segment = np.searchsorted(table.start, t, side="right") - 1
        h = (t - table.start[segment])[:, None]
        step = left_jacobian(table.angular[segment] * h) @ (table.linear[segment] * h)[..., None]
        relative = table.position[segment] + (table.rotation[segment] @ step)[..., 0]
        found.append((position + relative @ rotation.T)[:, :2])
    return found


def roads(scenario: Scenario) -> list[np.ndarray]:
    """Return the corners (4, 2) of each road."""
    found = []
    for road in scenario.roads:
        a, b = np.array([road.start, road.end]) - np.array(scenario.map.origin)[:2]
        along = (b - a) / max(float(np.linalg.norm(b - a)), 1e-9)
        aside = np.array([-along[1], along[0]]) * road.width / 2
        found.append(np.array([a - aside, b - aside, b + aside, a + aside]))
    return found


def pointers(origin: np.ndarray, point: np.ndarray, low: np.ndarray, high: np.ndarray, size: float) -> np.ndarray:
    """Return triangles (N, 3, 2) at the border that point to each `point` (N, 2) outside the picture; else NaN.

    The pointing lines come from `origin` (N, 2), or from the picture's middle where that is outside too. `low` and
    `high` are corners of the picture, `size` is the length of a triangle, m.
    """
    inside = np.all((point >= low) & (point <= high), axis=1, keepdims=True)
    start = np.where(np.all((origin > low) & (origin < high), axis=1, keepdims=True), origin, (low + high) / 2)
    way = np.where(inside, np.nan, point - start)
    room = np.where(way > 0, high - start, start - low)
    share = np.min(room / np.maximum(np.abs(way), 1e-9), axis=1, keepdims=True)
    ahead = size * way / np.linalg.norm(way, axis=1, keepdims=True)
    aside = 0.45 * ahead[:, ::-1] * [-1.0, 1.0]
    tip = start + share * way - 0.15 * ahead
    base = tip - ahead
    return np.stack([tip, base + aside, base - aside], axis=1)


def vehicle_mark(index: int) -> str:
    """Return the paper's name of a vehicle in plain text, f1 for the first."""
    return f"f{index + 1}"


_REACH = 0.4  # of the picture's side: how far a field of view is drawn of a camera that sees farther
_STAND_IN = 0.042  # of the scene's side, length of a vehicle without a body
_CAR = (4.4, 1.9, 1.5)  # proportions of a vehicle without a body

_ALL = slice(None)


class Stage:
    """The static side of a scene; lengths in m, everything in the map frame."""

    def __init__(self, scenario: Scenario) -> None:
        """Derive the static side from a scenario."""
        self.scenario = scenario
        self.landmarks, self.vehicles = len(scenario.landmarks), len(scenario.vehicles)
        self.origin = np.array(scenario.map.origin, float)
        low, high = limits(scenario)
        self.low, self.high = low, high
        """(2,) corners of a square in plan around all that is known beforehand."""
        self.side = float(high[0] - low[0])
        self.middle = np.array([*(low + high) / 2, 0.0])
        """(3,) of that square."""
        self._agents: list[Landmark | Vehicle] = [*scenario.landmarks, *scenario.vehicles]
        self.marker = np.array([agent.marker for agent in self._agents], float)
        """(A, 3) the point that cameras see, body frame."""
        self.camera = np.array([camera.position for camera in scenario.cameras], float)
        """(N, 3) optical centres, body frame."""
        limit = _REACH * self.side
        self.reach = np.array([min(c.range or limit, limit) * (c.model == "pinhole") for c in scenario.cameras])
        """(N,) how far fields of view are drawn."""
        self.moving = np.array([m.motion.kind != "static" for m in scenario.landmarks], dtype=bool)
        """(L,) which landmarks move."""

    def short_name(self, target: int) -> str:
        """Return f1 for the first vehicle, and a landmark's name; L1 for landmark_1."""
        if target >= self.landmarks:
            return vehicle_mark(target - self.landmarks)
        name = self.scenario.target_names[target]
        return f"L{name.removeprefix('landmark_')}" if name.startswith("landmark_") else name

    @cached_property
    def sees_a_part(self) -> bool:
        """True if a camera has a limited field of view that counts."""
        s = self.scenario
        sensed = s.topology.mode == "sensed" and s.sensing in ("sensed", "images")
        return sensed and any(camera.model == "pinhole" for camera in s.cameras)

    def bodies(self, least: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """Return (N, 3) sizes and (N, 3) centres of the vehicles' boxes, m; `least` is the least length drawn."""
        stand_in = Body(size=tuple(_STAND_IN * self.side / _CAR[0] * np.array(_CAR)))
        given = [v.body or stand_in for v in self.scenario.vehicles]
        size, center = np.array([b.size for b in given], float), np.array([b.center for b in given], float)
        grown = np.maximum(1.0, least / size[:, :1])
        return size * grown, center * grown

    @cached_property
    def floor(self) -> float:
        """Height of the ground, m: below the vehicles as they start, and no higher than the map's own."""
        size, center = self.bodies()
        starts = [v.initial_pose.position for v in self.scenario.vehicles if v.initial_pose]
        lowest = min((start[2] for start in starts if start), default=self.origin[2]) - self.origin[2]
        return float(lowest + np.min(center[:, 2] - size[:, 2] / 2))

    @cached_property
    def _fan(self) -> np.ndarray:
        """(N, K, 3) unit rays over the width of each camera's image, body frame without pan."""
        return np.array([camera_fan(camera) for camera in self.scenario.cameras])

    def nearer(self, points: np.ndarray, sides: float) -> np.ndarray:
        """Return points (N, D), those farther from the middle than so many sides moved there in their direction."""
        middle = self.middle[: points.shape[-1]]
        away = np.linalg.norm(points - middle, axis=-1, keepdims=True)
        return np.asarray(middle + (points - middle) * np.minimum(1.0, sides * self.side / np.maximum(away, 1e-9)))

    def eyes(self, frame: Frame) -> np.ndarray:
        """Return the positions (N, 3) of cameras."""
        return np.asarray(frame.position + (frame.rotation @ self.camera[..., None])[..., 0])

    def targets(self, frame: Frame) -> np.ndarray:
        """Return the points that cameras see, (A, 3)."""
        return np.asarray(frame.target_position + (frame.target_rotation @ self.marker[..., None])[..., 0])

    def reading_lines(self, frame: Frame, least: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """Return the vehicles (m,) of measurements by sensors beside the camera, and lines (m, 2, 3) that show them.

        A line to the target, or a cross on a sensor that measures its place, is shown until the next one is due.
        A cross is as wide as the longest body, or `least` m.
        """
        vehicles, lines = [np.empty(0, int)], [np.empty((0, 2, 3))]
        cross = max(least, self.bodies()[0].max()) / 2 * np.insert(CORNERS, 2, 0, axis=1)
        ticks, rate, targets = frame.reading_tick, self.scenario.rates.camera, self.targets(frame)
        for d, section in enumerate(self.scenario.sensors if ticks is not None else ()):
            kind, locates = section.made, section.white.max() < self.side
            arms = cross if kind.drawn == "cross" and locates else ()
            if ticks is not None and (len(arms) or (kind.drawn == "line" and kind.has_target)):
                since, period = frame.tick - ticks[:, d], max(1.0, rate / (section.rate or rate))
                i, target = np.nonzero((ticks[:, d] >= 0) & (since < period))
                start = frame.position[i] + frame.rotation[i] @ np.array(section.position)
                ends = [(start + arm, start) for arm in arms] or [(start, targets[target])]
                vehicles += [i] * len(ends)
                lines += [np.stack(pair, axis=1) for pair in ends]
        return np.concatenate(vehicles), np.concatenate(lines)

    def fields_of_view(self, frame: Frame, every: int = 1, of: slice = _ALL) -> np.ndarray | None:
        """Return the fields of view in plan as polygons (N, K + 1, 3), the camera first; None where all see everything.

        Buildings end them. Of the rays along the rim every so many are taken, and of the vehicles those `of` a slice.
        """
        if not self.sees_a_part:
            return None
        eye = self.eyes(frame)[of]
        turned = np.array([rotation_of(pan, None) for pan in frame.pan[of]]).reshape(-1, 3, 3)
        rays = self._fan[of, ::every] @ np.swapaxes(frame.rotation[of] @ turned, 1, 2)
        length = free_lengths(eye, rays, self.reach[of], self.buildings)
        return np.concatenate([eye[:, None], eye[:, None] + length[..., None] * rays], axis=1)

    def hider(self, frame: Frame, vehicle: int, target: int) -> str | None:
        """Return the short name of the box that hides a target from a vehicle's camera; None: no drawn box does."""
        kind = frame.sight[vehicle, target]
        if kind not in (Sight.OCCLUDED_BY_BUILDING, Sight.OCCLUDED_BY_BODY):
            return None
        own = (target, self.landmarks + vehicle)
        boxes = self.buildings if kind == Sight.OCCLUDED_BY_BUILDING else self.solid(frame, own)
        start, end = self.eyes(frame)[[vehicle]], self.targets(frame)[[target]]
        share = entries(start, end - start, boxes)[:, 0]
        return boxes[share.argmin()].name if (share < 1.0).any() else None

    @cached_property
    def buildings(self) -> list[Box]:
        """The buildings."""
        return [
            Box(o.name, rotation_of(o.yaw, None), np.array(o.center) - self.origin, o.size)
            for o in self.scenario.obstacles
        ]

    def solid(self, frame: Frame, without: tuple[int, ...] = ()) -> list[Box]:
        """Return the bodies that move, but for those of some agents."""
        boxes = []
        for i, agent in enumerate(self._agents):
            if (body := agent.body) is not None and i not in without:
                R = frame.target_rotation[i]
                boxes.append(Box(self.short_name(i), R, frame.target_position[i] + R @ body.center, body.size, i))
        there = np.flatnonzero(frame.traffic_half[:, 0] > 0.0)
        R, center, size = frame.traffic_rotation, frame.traffic_position, 2.0 * frame.traffic_half
        return boxes + [Box("traffic", R[z], center[z], size[z]) for z in there]
