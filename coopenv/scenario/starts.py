"""Initial poses and estimates, and the neighbours that each vehicle measures and receives."""

import warnings
from collections.abc import Sequence
from graphlib import CycleError, TopologicalSorter
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coopenv.base.errors import ScenarioWarning, listed, shown, suggest
from coopenv.scenario.base import rotation_of
from coopenv.scenario.bodies import Landmark, Vehicle
from coopenv.scenario.fields import ScenarioFields
from coopenv.scenario.routes import Route, route_points

SAME_PLACE = 1e-6  # m

BLOCK = 200_000  # pairs that are compared at a time; each takes some 400 bytes


def start_of(agent: Landmark | Vehicle, routes: Sequence[Route]) -> tuple[np.ndarray, np.ndarray]:
    """Return the nominal start of an agent: position (3,) in the file's coordinates, rotation (3, 3).

    Of a vehicle with routes it is on the first of them.
    """
    if agent.motion.kind == "waypoints":
        from coopenv.scenario.routes import path_heading  # here, as loading SciPy takes 0.3 s

        return np.array(agent.motion.waypoints[0].position), rotation_of(path_heading(agent.motion), None)
    if isinstance(agent, Landmark):
        return np.array(agent.position), rotation_of(agent.yaw, None)
    if agent.routes:
        return _beside(route_points(_routes_of(agent, routes)[0], np.zeros(1))[0], 0.0)
    pose = agent.initial_pose
    if pose is None or pose.position is None:  # the backend draws it
        return np.zeros(3), np.eye(3)
    return np.array(pose.position), rotation_of(pose.yaw, pose.quaternion_wxyz)


def _routes_of(vehicle: Vehicle, routes: Sequence[Route]) -> list[Route]:
    by_name = {route.name: route for route in routes}
    return [by_name[name] for name in vehicle.routes]


def _beside(point: np.ndarray, aside: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the pose at a distance (m) to the left of a point of a route, (x, y, heading) in m and rad."""
    x, y, heading = point
    position = np.array([x - aside * np.sin(heading), y + aside * np.cos(heading), 0.0])
    return position, rotation_of(heading, None)


def agent_starts(scenario: ScenarioFields) -> tuple[np.ndarray, np.ndarray]:
    """Return nominal start positions (A, 3) in the map frame and rotations (A, 3, 3), landmarks first."""
    agents: list[Landmark | Vehicle] = [*scenario.landmarks, *scenario.vehicles]
    starts = [start_of(agent, scenario.routes) for agent in agents]
    return np.array([p for p, _ in starts]) - np.array(scenario.map.origin), np.array([R for _, R in starts])


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


def overlapping_pairs(a: Boxes, b: Boxes) -> NDArray[np.int64]:
    """Return the indices (k, 2) of all boxes of `a` and `b` that overlap, in the order of `a`.

    If `b` is `a` itself, each pair of different boxes counts once, the larger index first.
    """
    radius_a, radius_b = np.linalg.norm(a.half, axis=1), np.linalg.norm(b.half, axis=1)
    rows = max(1, BLOCK // max(1, len(b.half)))
    found = [np.empty((0, 2), np.int64)]
    for first in range(0, len(a.half), rows):
        part = slice(first, first + rows)
        distance = np.linalg.norm(a.center[part, None] - b.center, axis=-1)
        near = distance <= radius_a[part, None] + radius_b
        i, j = np.nonzero(np.tril(near, first - 1) if b is a else near)
        i += first
        overlap = boxes_overlap(Boxes(*(x[i] for x in a)), Boxes(*(x[j] for x in b)))
        found.append(np.column_stack([i[overlap], j[overlap]]))
    return np.concatenate(found)


def possible_boxes(vehicle: Vehicle, routes: Sequence[Route]) -> Boxes:
    """Return the boxes of a vehicle at its nominal start, which comes first, and at the corners of its spread."""
    nominal = [start_of(vehicle, routes)]
    for route in _routes_of(vehicle, routes):
        spread = {0.0, route.lateral_spread, -route.lateral_spread}
        points = route_points(route, np.array([*{0.0, route.start_spread}]))
        nominal += [_beside(point, aside) for point in points for aside in spread]
    parts = [_spread_boxes(vehicle, *pose) for pose in nominal]
    return Boxes(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def _spread_boxes(vehicle: Vehicle, position: np.ndarray, rotation: np.ndarray) -> Boxes:
    pose = vehicle.initial_pose
    spread = np.array(pose.position_spread if pose else (0.0, 0.0, 0.0))
    turn = pose.yaw_spread if pose else 0.0
    corners = [(0, 0, 0, 0), *(product((-1, 1), repeat=4) if spread.any() or turn else ())]
    signs = np.array(corners, dtype=float)
    turned = {sign: rotation @ rotation_of(sign * turn, None) for sign in (-1.0, 0.0, 1.0)}
    rotations = np.array([turned[sign] for sign in signs[:, 3]])
    positions = position + (signs[:, :3] * spread) @ rotation.T
    center, size = (vehicle.body.center, vehicle.body.size) if vehicle.body else (np.zeros(3), np.zeros(3))
    return Boxes(positions + rotations @ np.array(center), rotations, np.tile(np.array(size) / 2, (len(signs), 1)))


def check_room(scenario: ScenarioFields) -> None:
    """Refuse (ValueError) vehicles that may start inside a building or in one another's place; warn of overlaps.

    Vehicles with routes are drawn such that they do not touch, and need not be apart here.
    """
    boxes = [possible_boxes(vehicle, scenario.routes) for vehicle in scenario.vehicles]
    _check_buildings(scenario, boxes)
    fixed = [i for i, vehicle in enumerate(scenario.vehicles) if not vehicle.routes]
    if not fixed:
        return
    starts = np.array([start_of(scenario.vehicles[i], scenario.routes)[0] for i in fixed])
    near = np.linalg.norm(starts[:, None] - starts, axis=-1) <= SAME_PLACE
    for second, first in np.argwhere(np.tril(near, -1))[:1].tolist():
        raise ValueError(_in_place(fixed[second], fixed[first]))
    nominal = Boxes(*(np.array([part[0] for part in parts]) for parts in zip(*(boxes[i] for i in fixed), strict=True)))
    overlaps = overlapping_pairs(nominal, nominal)
    if len(overlaps):
        more = f" (and those of {len(overlaps) - 1} more pairs)" if len(overlaps) > 1 else ""
        second, first = (fixed[i] for i in overlaps[0].tolist())
        warnings.warn(f"{_in_place(second, first)}: their boxes overlap{more}", ScenarioWarning, stacklevel=2)


def _in_place(second: int, first: int) -> str:
    return f"vehicles.{second}.initial_pose: vehicle_{second + 1} starts in the place of vehicle_{first + 1}"


def _check_buildings(scenario: ScenarioFields, boxes: Sequence[Boxes]) -> None:
    buildings = scenario.obstacles
    if not buildings:
        return
    walls = Boxes(
        np.array([o.center for o in buildings]),
        np.array([rotation_of(o.yaw, None) for o in buildings]),
        np.array([o.size for o in buildings]) / 2,
    )
    everywhere = Boxes(*(np.concatenate(parts) for parts in zip(*boxes, strict=True)))
    whose = np.repeat(np.arange(len(boxes)), [len(part.half) for part in boxes])
    for box, building in overlapping_pairs(everywhere, walls)[:1].tolist():
        i, name = int(whose[box]), buildings[building].name
        raise ValueError(f"vehicles.{i}.initial_pose: vehicle_{i + 1} starts inside obstacle '{name}'")


def neighbour_sets(scenario: ScenarioFields) -> list[list[int]]:
    """Return, per vehicle, the indices of the targets that it may measure.

    Without an explicit list these are all landmarks and, under the acyclic restriction, the vehicles before it
    (paper, Assumption 1: N_i within {1, ..., i-1}), otherwise all other vehicles.
    """
    landmarks, vehicles = len(scenario.landmarks), len(scenario.vehicles)
    index = {name: target for target, name in enumerate(scenario.target_names)}
    result = []
    for i, vehicle in enumerate(scenario.vehicles):
        own = landmarks + i
        if vehicle.neighbours is None:
            last = own if scenario.topology.acyclic else landmarks + vehicles
            result.append([*range(own), *range(own + 1, last)])
            continue
        where = f"vehicles.{i}.neighbours"
        for name in vehicle.neighbours:
            if name not in index:
                known = f"{suggest(name, index)}; known: {listed([*index])}"
                raise ValueError(f"{where}: unknown target {shown(name)}{known}")
            if index[name] == own:
                raise ValueError(f"{where}: a vehicle cannot be its own neighbour")
        result.append(sorted({index[name] for name in vehicle.neighbours}))
    return result


def processing_order(scenario: ScenarioFields, neighbours: Sequence[Sequence[int]]) -> list[int]:
    """Return vehicle indices so that leaders come before their followers, from the scenario's `neighbour_sets`.

    Raises:
        ValueError: the neighbour sets contain a cycle although `topology.acyclic` is set.
    """
    landmarks = len(scenario.landmarks)
    if not scenario.topology.acyclic:
        return list(range(len(neighbours)))
    leaders = [[j - landmarks for j in targets if j >= landmarks] for targets in neighbours]
    sorter = TopologicalSorter(dict(enumerate(leaders)))
    try:
        sorter.prepare()
    except CycleError as error:
        names = [f"vehicle_{i + 1}" for i in error.args[1]]
        cycle = " -> ".join(names if len(names) <= 8 else [*names[:6], f"{len(names) - 7} more", names[-1]])
        raise ValueError(
            f"topology: the neighbours form a cycle ({cycle}); the paper's Assumption 1 needs an acyclic order "
            "(or set topology.acyclic = false)"
        ) from None
    order: list[int] = []
    while sorter.is_active():
        ready = sorted(sorter.get_ready())
        order += ready
        sorter.done(*ready)
    return order
