"""Sites of parametric scenes: vehicles with what stands around them, and the two sites with vehicles at road speed.

On roads vehicles keep their speed and measure what is in range and not occluded: landmarks, and the vehicles before
them. Cars and vans have bodies that occlude.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

Point = tuple[float, float, float]

LANDMARKS: Mapping[str, Point] = {"SL1": (-4.0, 5.0, 3.0), "SL2": (4.0, 4.0, 5.0), "SL3": (4.0, -3.0, 4.0)}
"""Name to position, m; as in busy_intersection."""


class PlacedVehicle(NamedTuple):
    """One vehicle."""

    position: Point
    """m"""
    yaw: float
    """rad"""
    velocity: tuple[float, float]
    """m/s, along x and y of the body: to and fro, forwards on a circle, or forwards with a body."""
    turn: float
    """rad/s, to the left; 0: it drives to and fro, or straight on if it has a body."""
    neighbours: tuple[str, ...] = ()
    """Names of targets; empty: all landmarks and all vehicles before it."""
    size: Point | None = None
    """Length, width and height of its body, m."""


class Building(NamedTuple):
    """A building on the ground."""

    center: tuple[float, float]
    """m"""
    size: Point
    """Length, width and height, m."""


class Site(NamedTuple):
    """What a scene is made of. With a range, visibility is sensed; without, the graph is fixed."""

    vehicles: Sequence[PlacedVehicle]
    landmarks: Mapping[str, Point] = LANDMARKS
    buildings: Sequence[Building] = ()
    roads: Sequence[tuple[tuple[float, float], tuple[float, float]]] = ()
    """Both ends of each, m."""
    range: float | None = None
    """Of the cameras, m."""
    origin: tuple[float, float] = (0.0, 0.0)
    """Of the map, m."""


HORIZON = 50.0
"""s, for which landmarks line the roads."""
RANGE = 80.0
"""m, of the cameras."""
LANE = 3.5
"""m, width of a lane."""
CAR, VAN = (4.5, 1.8, 1.5), (5.5, 2.0, 2.6)
"""Length, width and height, m; every third vehicle is a van."""
HEADWAY, STANDSTILL = 1.5, 8.0
"""s and m: vehicles of a lane are STANDSTILL + HEADWAY * speed apart, from centre to centre."""
OVERTAKING = 1.1
"""Ratio of the speeds of the left and the right lane."""
POSTS, BRIDGES = 100.0, 4
"""m from one post to the next, which are on alternate sides, and posts from one sign bridge to the next."""
SIGNS, CORNER = 80.0, (8.0, 68.0)
"""m from one street sign to the next, and m from the axes to the near and the far side of a building at a corner."""
ARRIVAL = 10.0
"""s, after which the first two vehicles are in the middle of the crossing."""
CLEARANCE = (1.0, 12.0)
"""s, and m to drive: the time from one pair of vehicles in the crossing to the next."""


def _size(n: int) -> Point:
    return VAN if n % 3 == 2 else CAR


def road(vehicles: int, speed: float, lanes: int) -> Site:
    """Return a road in one direction, along x; the front vehicle comes first, and the left lane overtakes.

    Posts stand every 100 m, as on motorways, and every 400 m a bridge carries a sign.
    """
    fastest = speed * (OVERTAKING if lanes == 2 else 1.0)
    gap = STANDSTILL + HEADWAY * fastest
    placed = []
    for n in range(vehicles):
        lane = n % lanes
        y = (lane - (lanes - 1) / 2) * LANE
        placed.append(PlacedVehicle((-gap * n / lanes, y, 0.0), 0.0, ((speed, fastest)[lane], 0.0), 0.0, size=_size(n)))
    first, last = math.floor(-gap * vehicles / lanes / POSTS) - 1, math.ceil(fastest * HORIZON / POSTS) + 1
    side = lanes * LANE / 2 + 2.5
    landmarks = {}
    for k in range(last - first + 1):
        x = (first + k) * POSTS
        landmarks[f"post_{k + 1}"] = (x, side * (-1) ** k, 1.0)
        if k % BRIDGES == 1:
            landmarks[f"bridge_{k // BRIDGES + 1}"] = (x + POSTS / 2, 0.0, 6.5)
    ends = (first * POSTS, last * POSTS)
    return Site(
        placed, landmarks, roads=[((ends[0], 0.0), (ends[1], 0.0))], range=RANGE, origin=(round(sum(ends) / 2), 0.0)
    )


def crossroad(vehicles: int, speed: float) -> Site:
    """Return two roads that cross between four buildings; vehicles come from all sides, two opposite ones at a time.

    A pair has passed the crossing before the next one, from the other road, comes.
    """
    period = CLEARANCE[0] + CLEARANCE[1] / speed
    placed = []
    for n in range(vehicles):
        quarter = (n // 2) % 2 + 2 * (n % 2)  # east, west, north, south
        before = speed * (ARRIVAL + period * (n // 2))
        x, y = _turned(quarter, -before, -LANE / 2)
        placed.append(PlacedVehicle((x, y, 0.0), quarter * math.pi / 2, (speed, 0.0), 0.0, size=_size(n)))
    arm = max(speed * (HORIZON - ARRIVAL), speed * (ARRIVAL + period * ((vehicles - 1) // 2))) + SIGNS
    landmarks = {f"corner_{q + 1}": (*_turned(q, 6.0, 6.0), 3.0) for q in range(4)}
    for q in range(4):
        for k in range(math.ceil(arm / SIGNS)):
            landmarks[f"sign_{q + 1}_{k + 1}"] = (*_turned(q, SIGNS * (k + 0.5), 5.5 * (-1) ** k), 2.5 + k % 2)
    near, far = CORNER
    middle, width = (near + far) / 2, far - near
    buildings = [Building(_turned(q, middle, middle), (width, width, 12.0)) for q in range(4)]
    return Site(placed, landmarks, buildings, [((-arm, 0.0), (arm, 0.0)), ((0.0, -arm), (0.0, arm))], RANGE)


def _turned(quarters: int, x: float, y: float) -> tuple[float, float]:
    """Return a point after quarter turns to the left."""
    for _ in range(quarters):
        x, y = -y, x
    return x, y


def site_of(built: Site | Iterator[PlacedVehicle]) -> Site:
    """Return the site of a scene, by default with the three landmarks of busy_intersection."""
    return built if isinstance(built, Site) else Site(tuple(built))
