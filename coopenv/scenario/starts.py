"""Room for vehicles at their starts: outside of buildings and of one another."""

import warnings
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from coopenv.base.errors import ScenarioWarning
from coopenv.scenario.bodies import Obstacle, Vehicle
from coopenv.scenario.routes import Boxes, Route, overlapping_pairs, possible_boxes, start_of
from coopenv.scenario.sensing import rotation_of

SAME_PLACE = 1e-6  # m

MOST_STARTS, MOST_CORNERS = 500_000, 1_000_000
"""Boxes in which vehicles may start, and pairs of them that are compared for a warning."""


def check_room(vehicles: Sequence[Vehicle], routes: Sequence[Route], obstacles: Sequence[Obstacle]) -> None:
    """Refuse (ValueError) vehicles that may start inside a building or in one another's place; warn of overlaps.

    Vehicles with routes are drawn such that they do not touch, if they can: only those are named whose starts mostly
    overlap.
    """
    known = {route.name: route for route in routes}
    equal: dict[Any, int] = {}
    kinds: list[int] = []  # vehicles that start in the same boxes have one number
    boxes, count = list[Boxes](), 0
    for i, v in enumerate(vehicles):
        kinds.append(equal.setdefault((v.routes, v.initial_pose, v.body, vars(v.motion).get("waypoints")), len(equal)))
        if len(equal) > len(boxes):
            boxes.append(possible_boxes(v, known))
            count += len(boxes[-1].half)
        if count > MOST_STARTS:
            raise ValueError(f"vehicles.{i}: routes and spreads up to this vehicle are over {MOST_STARTS:,} starts")
    if obstacles:
        walls = Boxes(
            np.array([o.center for o in obstacles]),
            np.array([rotation_of(o.yaw, None) for o in obstacles]),
            np.array([o.size for o in obstacles]) / 2,
        )
        everywhere = Boxes(*(np.concatenate(parts) for parts in zip(*boxes, strict=True)))
        whose = np.repeat(np.arange(len(boxes)), [len(part.half) for part in boxes])
        for box, building in _pairs(everywhere, walls):
            i, name = kinds.index(whose[box]), obstacles[building].name
            raise ValueError(f"vehicles.{i}.initial_pose: vehicle_{i + 1} starts inside obstacle '{name}'")
    fixed = [i for i, vehicle in enumerate(vehicles) if not vehicle.routes]
    starts = np.array([start_of(vehicles[i], known)[0] for i in fixed]).reshape(-1, 3)
    points = Boxes(starts, np.tile(np.eye(3), (len(starts), 1, 1)), np.full_like(starts, SAME_PLACE / 2))
    for second, first in _pairs(points, points):
        raise ValueError(_in_place(vehicles, fixed[second], fixed[first]))
    for second, first in _overlapping_starts(vehicles, boxes, kinds):
        warnings.warn(f"{_in_place(vehicles, second, first)}: their boxes overlap", ScenarioWarning, stacklevel=2)
        return


def _pairs(a: Boxes, b: Boxes) -> Iterator[list[int]]:
    return (pair for block in overlapping_pairs(a, b) for pair in block.tolist())


def _overlapping_starts(
    vehicles: Sequence[Vehicle], boxes: Sequence[Boxes], kinds: Sequence[int]
) -> Iterator[tuple[int, int]]:
    """Yield vehicles whose nominal boxes overlap, with routes only if most of their possible boxes do.

    Vehicles that wait for their entry have none. `boxes` are those of each kind of vehicle. The search is for a doubt
    alone: it ends after `MOST_CORNERS`.
    """
    nominal = Boxes(*(np.array([boxes[kind][part][0] for kind in kinds]) for part in range(3)))
    known: dict[tuple[int, int], bool] = {}
    compared = 0
    for i, j in _pairs(nominal, nominal):
        one, other = vehicles[i], vehicles[j]
        if one.routes or other.routes:
            if one.entry or other.entry:
                continue
            key = kinds[i], kinds[j]
            if key not in known:
                a, b = boxes[key[0]], Boxes(*boxes[key[1]])  # a copy: all pairs of two vehicles of one kind
                count = len(a.half) * len(b.half)
                compared += count
                if compared > MOST_CORNERS:
                    return
                known[key] = 2 * sum(map(len, overlapping_pairs(a, b))) > count
            if not known[key]:
                continue
        yield i, j


def _in_place(vehicles: Sequence[Vehicle], second: int, first: int) -> str:
    key = "routes" if vehicles[second].routes else "initial_pose"
    return f"vehicles.{second}.{key}: vehicle_{second + 1} starts in the place of vehicle_{first + 1}"
