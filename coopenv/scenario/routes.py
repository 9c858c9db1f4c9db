"""Routes that vehicles follow, prescribed motions, and where agents start."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Annotated, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from coopenv.base import units
from coopenv.base.sections import NonNegative, Positive, Section, Vector2
from coopenv.scenario.bodies import ConstantMotion, Landmark, SegmentMotion, Vehicle, WaypointMotion
from coopenv.scenario.sensing import rotation_of

SPACING = 0.25  # m between the points of a route that is not straight ...
MOST_POINTS = 64  # ... and how many there are at most

STRAIGHT = 1e-6  # rad; a smaller turn at a waypoint is no corner


@dataclass(frozen=True, eq=False)  # arrays cannot be compared where routes are
class Shape:
    """Geometry of a route's L legs and L + 1 waypoints."""

    length: np.ndarray  # (L,) m
    heading: np.ndarray  # (L,) rad
    turn: np.ndarray  # (L + 1,) rad, positive to the left; 0 at both ends
    cut: np.ndarray  # (L + 1,) m before and behind a waypoint, where its arc begins and ends


@dataclass(frozen=True, eq=False)
class Pieces:
    """Straight lines and arcs, one after the other."""

    position: np.ndarray  # (n, 2) m, where they begin
    heading: np.ndarray  # (n,) rad, there
    curvature: np.ndarray  # (n,) 1/m, positive to the left
    length: np.ndarray  # (n,) m


class Signal(Section):
    """A traffic light with a fixed cycle, which the model of traffic obeys."""

    at: Annotated[NonNegative, units.DISTANCE]
    """Arc length of the stop line on the route as designed, m."""
    period: Annotated[Positive, units.TIME]
    """Duration of a cycle, s."""
    start: Annotated[NonNegative, units.TIME] = 0.0
    """Begin of the green time in every cycle, s."""
    green: Annotated[NonNegative, units.TIME]
    """Duration of the green time, s."""


class Route(Section):
    """A way that vehicles are to go, of which every reset draws a variant."""

    name: str = Field(min_length=1, max_length=64, pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$")
    waypoints: Annotated[tuple[Vector2, ...], units.PLACE] = Field(min_length=2, max_length=1000)
    """x and y in the coordinates of this file, m; the route lies at z = 0 and must not come near itself."""
    corner_radius: Annotated[NonNegative, units.EXTENT] = 0.0
    """Radius of the arcs that round the corners, m."""
    lateral_spread: Annotated[NonNegative, units.LENGTH] = 0.0
    """Half-width of a uniform sideways shift of the whole route, m."""
    wander: Annotated[NonNegative, units.LENGTH] = 0.0
    """Largest further sideways deviation, m: two waves with random phases, which vanish at both ends."""
    start_spread: Annotated[NonNegative, units.DISTANCE] = 0.0
    """The start is drawn uniformly along the first so many metres."""
    signal: Signal | None = None

    @property
    def breadth(self) -> float:
        """Farthest that a drawn route is from the waypoints' line, m."""
        return self.lateral_spread + self.wander

    @cached_property
    def shape(self) -> Shape:
        """Straight lines and turns of the route."""
        leg = np.diff(np.array(self.waypoints), axis=0)
        heading = np.arctan2(leg[:, 1], leg[:, 0])
        turn = np.zeros(len(self.waypoints))
        turn[1:-1] = (np.diff(heading) + np.pi) % (2 * np.pi) - np.pi
        turn[np.abs(turn) <= STRAIGHT] = 0.0
        return Shape(np.linalg.norm(leg, axis=1), heading, turn, self.corner_radius * np.tan(np.abs(turn) / 2))

    @cached_property
    def pieces(self) -> Pieces:
        """Straight lines and arcs from its beginning to its end."""
        length, heading, turn, cut = vars(self.shape).values()
        points, ahead, radius = np.array(self.waypoints), _direction(heading), self.corner_radius
        rows = np.zeros((len(length), 2, 5))  # a line, then the arc at its end
        rows[:, 0, :2], rows[:, 0, 4] = points[:-1] + cut[:-1, None] * ahead, length - cut[:-1] - cut[1:]
        rows[:, 1, :2], rows[:, 1, 4] = points[1:] - cut[1:, None] * ahead, radius * np.abs(turn[1:])
        rows[:, :, 2] = heading[:, None]
        rows[:, 1, 3] = np.copysign(1.0 / radius if radius else 0.0, turn[1:])
        there = np.column_stack([rows[:, 0, 4] > 1e-9, cut[1:] > 0.0])
        return Pieces(rows[there, :2], *rows[there, 2:].T)

    @cached_property
    def start_corners(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions (K, 3), m, and rotations (K, 3, 3): the nominal start, then the ends of its spread."""
        points = route_points(self, np.array(sorted({0.0, self.start_spread})))
        aside = np.array([0.0, self.lateral_spread, -self.lateral_spread][: 3 if self.lateral_spread else 1])
        positions = np.zeros((len(points), len(aside), 3))
        positions[..., :2] = points[:, None, :2] + aside[:, None] * _direction(points[:, 2:] + math.pi / 2)
        rotations = np.array([rotation_of(heading, None) for heading in points[:, 2]])
        return positions.reshape(-1, 3), rotations.repeat(len(aside), axis=0)

    @model_validator(mode="after")
    def _is_possible(self) -> Self:
        for problem in _problems(self):
            raise ValueError(problem)
        return self


def route_length(route: Route) -> float:
    """Return the length of a route as designed, m."""
    return math.fsum(route.pieces.length)


def point_count(route: Route) -> int:
    """Return the number of points of a route; a straight line has its two ends."""
    straight = route.wander == 0.0 and not route.shape.turn.any()
    return 2 if straight else min(MOST_POINTS, math.ceil(route_length(route) / SPACING) + 1)


def route_points(route: Route, s: np.ndarray) -> np.ndarray:
    """Return (x, y, heading), (K, 3) in m and rad, of a route as designed at arc lengths s (K,), m."""
    begin = np.concatenate([[0.0], np.cumsum(route.pieces.length)[:-1]])
    which = np.clip(np.searchsorted(begin, s, side="right") - 1, 0, None)
    position, heading, curvature, _ = (values[which] for values in vars(route.pieces).values())
    h = np.asarray(s) - begin[which]
    turn = curvature * h
    chord, middle = h * np.sinc(turn / (2 * np.pi)), heading + turn / 2
    return np.column_stack([position + chord[:, None] * _direction(middle), heading + turn])


def even_points(route: Route) -> np.ndarray:
    """Return the points (K, 3) of `point_count` at even arc length from end to end."""
    return route_points(route, np.linspace(0.0, route_length(route), point_count(route)))


def _direction(heading: np.ndarray) -> np.ndarray:
    direction = np.empty((*heading.shape, 2))
    direction[..., 0], direction[..., 1] = np.cos(heading), np.sin(heading)
    return direction


def _problems(route: Route) -> Iterator[str]:
    length, _, turn, cut = vars(route.shape).values()
    for i in np.flatnonzero(length < 1e-6):
        yield f"waypoints.{i + 1}: the same place as the waypoint before"
    for i in np.flatnonzero(np.abs(turn) > math.pi - 1e-3):
        yield f"waypoints.{i}: the route turns back on itself there"
    for i in np.flatnonzero(cut[:-1] + cut[1:] > length + 1e-9):
        corner = i if cut[i] > cut[i + 1] else i + 1
        yield (
            f"corner_radius: {route.corner_radius:g} m is too large for the corner at waypoints.{corner}: its arc "
            f"does not fit into the {length[i]:g} m between waypoints.{i} and waypoints.{i + 1}"
        )
    if turn.any() and route.breadth > 0.0 and route.breadth >= route.corner_radius:
        yield (
            f"corner_radius: {route.corner_radius:g} m must be above lateral_spread + wander ({route.breadth:g} m), or "
            "the route would fold in its corners"
        )
    if route.start_spread >= (total := route_length(route)):
        yield f"start_spread: {route.start_spread:g} m must be below the route's length ({total:g} m)"


MOST_FOLLOWERS = 2_000_000
"""Pairs of routes of which one may follow the other."""


def followers(vehicle: Vehicle, routes: Sequence[Route]) -> list[list[int]]:
    """Return, per route, the numbers of those that may follow: as designed they start within the radius of its end.

    Raises:
        ValueError: there are more than `MOST_FOLLOWERS` pairs.
    """
    from scipy.spatial import cKDTree  # here, as names are looked up without SciPy

    if not routes:
        return []
    starts, ends = (np.array([route.waypoints[end] for route in routes]) for end in (0, -1))
    named = {*vehicle.next_routes}
    allowed = {i for i, route in enumerate(routes) if not named or route.name in named}
    tree, radius = cKDTree(starts), vehicle.goal_radius
    if (count := tree.query_ball_point(ends, radius, return_length=True).sum()) > MOST_FOLLOWERS:
        raise ValueError(f"routes: {count} pairs may follow one another within {radius:g} m, over {MOST_FOLLOWERS:.0e}")
    near = tree.query_ball_point(ends, radius, return_sorted=True)
    return [[i for i in row if i in allowed] for row in near]


SPLINE_STEP = 0.02
"""Period (s) of the poses at which a waypoint spline is met exactly ..."""
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
    from scipy.spatial.transform import Rotation  # here, as names are looked up without SciPy

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
    from scipy.spatial.transform import Rotation  # here, as names are looked up without SciPy

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


BLOCK = 20_000
"""Pairs of boxes that are compared at a time; each takes some 400 bytes."""
NEAR_COST, MOST_COMPARED = 40, 20_000_000
"""Cost of two boxes whose spheres overlap, in comparisons of two spheres, and the limit of one search."""


def start_of(agent: Landmark | Vehicle, routes: Mapping[str, Route]) -> tuple[np.ndarray, np.ndarray]:
    """Return the nominal start of an agent: position (3,) in the file's coordinates, rotation (3, 3).

    Of a vehicle with routes it is on the first of them.
    """
    if agent.motion.kind == "waypoints":
        return np.array(agent.motion.waypoints[0].position), rotation_of(path_heading(agent.motion), None)
    if isinstance(agent, Landmark):
        return np.array(agent.position), rotation_of(agent.yaw, None)
    if agent.routes:
        positions, rotations = routes[agent.routes[0]].start_corners
        return positions[0], rotations[0]
    pose = agent.initial_pose
    if pose is None or pose.position is None:  # the backend draws it
        return np.zeros(3), np.eye(3)
    return np.array(pose.position), rotation_of(pose.yaw, pose.quaternion_wxyz)


class Boxes(NamedTuple):
    """n boxes; a half size of zero makes a point."""

    center: NDArray[np.float64]  # (n, 3) m
    rotation: NDArray[np.float64]  # (n, 3, 3)
    half: NDArray[np.float64]  # (n, 3) half of the edges, m


def boxes_overlap(a: Boxes, b: Boxes) -> NDArray[np.bool_]:
    """Return (n,) which boxes of `a` overlap those of `b` at the same place (separating axis theorem).

    Source: Gottschalk, Lin, Manocha, OBBTree, SIGGRAPH 1996.
    """
    A, B = np.swapaxes(a.rotation, 1, 2), np.swapaxes(b.rotation, 1, 2)
    edges = np.cross(A[:, :, None], B[:, None, :]).reshape(-1, 9, 3)
    axes = np.concatenate([A, B, edges], axis=1)
    reach = (np.abs(axes @ a.rotation) @ a.half[..., None] + np.abs(axes @ b.rotation) @ b.half[..., None])[..., 0]
    apart = np.abs(axes @ (b.center - a.center)[..., None])[..., 0] >= reach
    parallel = np.linalg.norm(axes, axis=-1) <= 1e-9  # edges without a plane between them
    return np.asarray(~(apart & ~parallel).any(axis=1))


def overlapping_pairs(a: Boxes, b: Boxes) -> Iterator[NDArray[np.int64]]:
    """Yield the indices (k, 2) of the boxes of `a` and `b` that overlap, in blocks and in the order of `a`.

    If `b` is `a` itself, each pair of different boxes counts once, the larger index first. The search ends at
    `MOST_COMPARED`, so that its time is bounded.
    """
    radius_a, radius_b = np.linalg.norm(a.half, axis=1), np.linalg.norm(b.half, axis=1)
    axis = np.ptp(b.center, axis=0).argmax() if len(b.center) else 0  # along it boxes are far apart
    order = np.argsort(b.center[:, axis])
    reach = (radius_a + radius_b.max(initial=0.0)) * (1.0 + 1e-9)  # against rounding
    first, last = (np.searchsorted(b.center[order, axis], a.center[:, axis] + side * reach) for side in (-1.0, 1.0))
    count, compared = last - first, 0
    for rows in np.split(np.arange(len(count)), np.flatnonzero(np.diff(np.cumsum(count) // BLOCK)) + 1):
        before = np.cumsum(count[rows]) - count[rows]
        i = np.repeat(rows, count[rows])
        j = order[np.arange(len(i)) + np.repeat(first[rows] - before, count[rows])]
        near = np.linalg.norm(a.center[i] - b.center[j], axis=1) <= radius_a[i] + radius_b[j]
        if b is a:
            near &= j < i
        pairs = np.column_stack([i[near], j[near]])
        compared += len(near) + NEAR_COST * len(pairs)
        i, j = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))].T
        overlap = boxes_overlap(Boxes(*(x[i] for x in a)), Boxes(*(x[j] for x in b)))
        yield np.column_stack([i[overlap], j[overlap]])
        if compared > MOST_COMPARED:
            return


def possible_boxes(vehicle: Vehicle, routes: Mapping[str, Route]) -> Boxes:
    """Return the boxes of a vehicle at its nominal start, which comes first, and at the corners of its spread."""
    if vehicle.routes:
        starts = [routes[name].start_corners for name in vehicle.routes]
        positions, rotations = (np.concatenate(part) for part in zip(*starts, strict=True))
    else:
        positions, rotations = (part[None] for part in start_of(vehicle, routes))
    pose = vehicle.initial_pose
    if pose and (any(pose.position_spread) or pose.yaw_spread):
        signs = np.array([(0, 0, 0, 0), *product((-1, 1), repeat=4)], dtype=float)
        moved = signs[:, :3] * np.array(pose.position_spread)
        turned = np.array([rotation_of(sign * pose.yaw_spread, None) for sign in signs[:, 3]])
        positions = (positions[:, None] + moved @ np.swapaxes(rotations, 1, 2)).reshape(-1, 3)
        rotations = (rotations[:, None] @ turned).reshape(-1, 3, 3)
    center, size = (vehicle.body.center, vehicle.body.size) if vehicle.body else (np.zeros(3), np.zeros(3))
    return Boxes(positions + rotations @ np.array(center), rotations, np.tile(np.array(size) / 2, (len(positions), 1)))
