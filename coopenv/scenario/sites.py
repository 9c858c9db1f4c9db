"""Sites: surroundings of the vehicles of parametric scenes, and the grid of streets of scenario files.

On the roads of scenes vehicles keep their speed and measure what is in range and not occluded: landmarks, and the
vehicles before them. Cars and vans have bodies that occlude. In a scenario file the table `streets` stands for roads,
buildings, signs, signals and routes.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from typing import Annotated, Any, NamedTuple, Self

from pydantic import Field, model_validator

from coopenv.base import units
from coopenv.base.errors import ScenarioError
from coopenv.base.sections import NonNegative, Positive, PositiveVector2, Section, validated

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
    """Parts of a scene. With a range, visibility is sensed; without, the graph is fixed."""

    vehicles: Sequence[PlacedVehicle]
    landmarks: Mapping[str, Point] = LANDMARKS
    buildings: Sequence[Building] = ()
    roads: Sequence[tuple[tuple[float, float], tuple[float, float]]] = ()
    """Both ends of each road, m."""
    range: float | None = None
    """Range of the cameras, m."""
    origin: tuple[float, float] = (0.0, 0.0)
    """Origin of the map, m."""


HORIZON = 50.0
"""s, for which landmarks line the roads."""
RANGE = 80.0
"""m, of the cameras."""
LANE = 3.5
"""m, width of a lane."""
CAR, VAN = (4.5, 1.8, 1.5), (5.5, 2.0, 2.6)
"""Length, width and height, m; every third vehicle is a van."""
HEADWAY, STANDSTILL = 1.5, 8.0
"""Headway, s, and distance at standstill, m: centres of vehicles in a lane are STANDSTILL + HEADWAY * speed apart."""
OVERTAKING = 1.1
"""Ratio of the speeds of the left and the right lane."""
POSTS, BRIDGES = 100.0, 4
"""Distance (m) between posts, which are on alternate sides, and number of posts between sign bridges."""
SIGNS, CORNER = 80.0, (8.0, 68.0)
"""Distance (m) between street signs, and from the axes to the near and the far side of a corner building."""
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


STREETS_KEY = "streets"
"""The table of the file."""
HEADINGS = {"east": (1, 0), "north": (0, 1), "west": (-1, 0), "south": (0, -1)}
TURNS = ("straight", "right")
CORNER_RADIUS = 6.0
"""m, of right turns."""
FACADE = 0.1
"""Distance (m) of a sign from its building's wall."""
STARTS = 2
"""Streets in a row, in one of which a vehicle without `routes` of its own starts."""

Count = Annotated[int, Field(ge=1, le=64)]


class Streets(Section):
    """Blocks with a building each, between streets with one lane per direction, about the file's origin.

    Right-hand traffic; vehicles go straight on or turn right at the signal of every crossing, where the streets to the
    east and west, and those to the north and south, are green in turns. Half a block beyond the outer crossings the
    streets end.
    """

    blocks: tuple[Count, Count]
    """Blocks along x and y."""
    block: Annotated[Annotated[float, Field(ge=40.0, le=1000.0)], units.DISTANCE] = 80.0
    """m, from one street's axis to the next."""
    lane: Annotated[Annotated[float, Field(ge=2.5, le=5.0)], units.LENGTH] = 3.5
    """Width of a lane, m."""
    pavement: Annotated[Annotated[float, Field(ge=0.5, le=6.0)], units.LENGTH] = 3.0
    """Distance from a street to the buildings, m."""
    height: Annotated[Positive, units.EXTENT] = 12.0
    """Height of the buildings, m."""
    signs: Annotated[int, Field(ge=1, le=1000)] = 4
    """Landmarks per block, drawn along its facades."""
    sign_height: Annotated[PositiveVector2, units.EXTENT] = (2.0, 5.0)
    """Lowest and highest z, m."""
    period: Annotated[Positive, units.TIME] = 28.0
    """Period of the signals, s."""
    clearance: Annotated[NonNegative, units.TIME] = 4.0
    """Time between green phases, s."""
    lateral_spread: Annotated[NonNegative, units.LENGTH] = 0.2
    """Lateral spread of the routes, m."""

    @model_validator(mode="after")
    def _is_possible(self) -> Self:
        if self.clearance >= self.period / 2:
            raise ValueError(f"clearance: {self.clearance:g} s must be below half the period, {self.period / 2:g} s")
        if self.sign_height[1] > self.height:
            raise ValueError(f"sign_height: {self.sign_height[1]:g} m is above the `height`, {self.height:g} m")
        return self


def with_streets(raw: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Return the plain data of a file with what its table `streets` stands for.

    Driven vehicles and traffic without `routes` get some: those with an `entry` come into the city from its edge, the
    others start within. Raises ScenarioError: the table, or a list that it adds to, is not as it should be.
    """
    filled = dict(raw)
    if STREETS_KEY not in filled:
        return filled
    streets = validated(Streets, filled.pop(STREETS_KEY), f"{where}: {STREETS_KEY}", ScenarioError)
    units.warn_of_implausible(streets, {}, STREETS_KEY)
    made = {"roads": _roads(streets), "obstacles": _buildings(streets), "landmark_groups": _signs(streets)}
    for key, tables in {**made, "routes": _routes(streets), "vehicles": iter(())}.items():
        if not isinstance(filled.get(key, []), list):
            raise ScenarioError(f"{where}: {key}: must be a list of tables")
        filled[key] = [*filled.get(key, []), *tables]
    crossings = {f"{i + 1}_{j + 1}" for i, j in product(*map(range, [count + 1 for count in streets.blocks]))}
    for enters in (False, True):
        starts = [
            name
            for name, (dx, dy), i, j in _approaches(streets)
            if (f"{i + 1 - dx}_{j + 1 - dy}" not in crossings) == enters
        ]
        chosen = [k for k, v in enumerate(filled["vehicles"]) if _has_no_route(v) and ("entry" in v) == enters]
        for n, k in enumerate(chosen):
            first = n * len(starts) // len(chosen)
            own = [f"{starts[(first + m) % len(starts)]}_{turn}" for m, turn in product(range(STARTS), TURNS)]
            filled["vehicles"][k] = {**filled["vehicles"][k], "routes": own}
    return filled


def _has_no_route(vehicle: Any) -> bool:
    motion = vehicle.get("motion") if isinstance(vehicle, Mapping) else None
    return isinstance(motion, Mapping) and motion.get("kind") in ("driven", "traffic") and "routes" not in vehicle


def _approaches(streets: Streets) -> Iterator[tuple[str, tuple[int, int], int, int]]:
    """Yield name, heading, column and row of every way to a crossing."""
    columns, rows = (range(count + 1) for count in streets.blocks)
    for i, j, (name, heading) in product(columns, rows, HEADINGS.items()):
        yield f"{name}_{i + 1}_{j + 1}", heading, i, j


def _axes(streets: Streets) -> tuple[list[float], list[float]]:
    """Return x of the streets to the north and y of those to the east, m."""
    along = [[streets.block * (k - count / 2) for k in range(count + 1)] for count in streets.blocks]
    return along[0], along[1]


def _roads(streets: Streets) -> Iterator[dict[str, Any]]:
    (xs, ys), beyond, width = _axes(streets), streets.block / 2, 2 * streets.lane
    for x in xs:
        yield {"start": [x, ys[0] - beyond], "end": [x, ys[-1] + beyond], "width": width}
    for y in ys:
        yield {"start": [xs[0] - beyond, y], "end": [xs[-1] + beyond, y], "width": width}


def _buildings(streets: Streets) -> Iterator[dict[str, Any]]:
    (xs, ys), half = _axes(streets), streets.block / 2
    size = streets.block - 2 * (streets.lane + streets.pavement)
    for (i, x), (j, y) in product(enumerate(xs[:-1]), enumerate(ys[:-1])):
        center = [x + half, y + half, streets.height / 2]
        yield {"name": f"block_{i + 1}_{j + 1}", "center": center, "size": [size, size, streets.height]}


def _signs(streets: Streets) -> Iterator[dict[str, Any]]:
    """Yield a group of landmarks on the four facades of every building."""
    for house in _buildings(streets):
        (x, y, _), r = house["center"], house["size"][0] / 2 + FACADE
        corners = [[x - r, y - r], [x + r, y - r], [x + r, y + r], [x - r, y + r]]
        lines = [{"start": corners[k - 1], "end": corners[k]} for k in range(4)]
        yield {"name": house["name"], "count": streets.signs, "lines": lines, "height": list(streets.sign_height)}


def _routes(streets: Streets) -> Iterator[dict[str, Any]]:
    """Yield the routes across every crossing, half a block long on both sides."""
    (xs, ys), half, aside = _axes(streets), streets.block / 2, streets.lane / 2
    stop, cycle = half - streets.lane - streets.pavement, streets.period / 2
    for name, (dx, dy), i, j in _approaches(streets):
        phase = cycle * ((i + j + (dx == 0)) % 2)
        signal = {"at": stop, "period": streets.period, "start": phase, "green": cycle - streets.clearance}
        for turn, (ex, ey) in zip(TURNS, ((dx, dy), (dy, -dx)), strict=True):  # headings behind the crossing
            begin = [xs[i] - half * dx + aside * dy, ys[j] - half * dy - aside * dx]
            corner = [xs[i] + aside * (dy + ey), ys[j] - aside * (dx + ex)]
            end = [xs[i] + half * ex + aside * ey, ys[j] + half * ey - aside * ex]
            yield {
                "name": f"{name}_{turn}",
                "waypoints": [begin, end] if turn == "straight" else [begin, corner, end],
                "corner_radius": CORNER_RADIUS,
                "lateral_spread": streets.lateral_spread,
                "start_spread": stop / 2,
                "signal": signal,
            }
