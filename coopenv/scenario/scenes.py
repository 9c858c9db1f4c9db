"""Parametric scenes: lanes, trees, random graphs and rings of any number of vehicles."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from coopenv.base.errors import UnknownEnvironmentError, listed, shown, suggest

LANDMARKS = {"SL1": (-4.0, 5.0, 3.0), "SL2": (4.0, 4.0, 5.0), "SL3": (4.0, -3.0, 4.0)}
"""Name to position, m; as in busy_intersection."""

TARGETS = 3
"""Bearings with which a pose is observable; a vehicle with fewer neighbours measures landmarks besides."""

NORTH, EAST = (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)


class Straight(NamedTuple):
    """To and fro, without turning."""

    velocity: tuple[float, float, float]
    """m/s, body frame."""


class Round(NamedTuple):
    """Forwards on a circle."""

    speed: float
    """m/s"""
    turn: float
    """rad/s, to the left."""


class Placed(NamedTuple):
    """One vehicle."""

    position: tuple[float, float, float]
    """m"""
    yaw: float
    """rad"""
    motion: Straight | Round
    neighbours: tuple[str, ...]


def _filled(vehicles: Sequence[int], first: int = 0) -> tuple[str, ...]:
    """Return the names of vehicles (from 1 on) and of as many landmarks as make `TARGETS`."""
    names = list(LANDMARKS)
    some = [names[(first + n) % len(names)] for n in range(max(0, TARGETS - len(vehicles)))]
    return (*sorted(some), *(f"vehicle_{i}" for i in vehicles))


def _along(direction: tuple[float, float, float], speed: float) -> Straight:
    return Straight((direction[0] * speed, direction[1] * speed, 0.0))


def lane(vehicles: int, seen: int) -> list[Placed]:
    """Return a lane: 3 m from one to the next, all at one speed."""
    placed = []
    for k in range(vehicles):
        side, up = (0.5 * (-1) ** k, 0.3 * (k % 3)) if k else (0.0, 0.0)
        leaders = [i for i in range(k - seen + 1, k + 1) if i >= 1]
        placed.append(Placed((-2.0 + side, -10.0 - 3.0 * k, 2.5 + up), 0.0, _along(NORTH, 0.5), _filled(leaders)))
    return placed


def roots(vehicles: int) -> list[Placed]:
    """Return two streets that cross, odd numbers on that to the north; speeds differ a little."""
    landmarks = tuple(LANDMARKS)
    placed = [
        Placed((-2.0, -16.0, 2.5), 0.0, _along(NORTH, 0.6), landmarks),
        Placed((-17.0, 2.0, 3.0), 0.0, _along(EAST, 0.6), landmarks),
    ]
    for n in range(3, vehicles + 1):
        back, aside = -19.0 - 3.0 * ((n - 3) // 2), 0.3 * (-1) ** (n // 2)
        north = n % 2 == 1
        x, y = (-2.0 + aside, back) if north else (back, 2.0 + aside)
        leaders = {3: (1, 2), 4: (1, 3)}.get(n, (n - 4, n - 3, n - 2))
        speed = 0.5 + 0.02 * ((n - 3) % 8)
        motion = _along(NORTH if north else EAST, speed)
        placed.append(Placed((x, y, 2.0 + 0.5 * (n % 4)), 0.0, motion, _filled(leaders, n - 2)))
    return placed


def tree(vehicles: int, seen: int) -> list[Placed]:
    """Return a binary tree, a level of it on a circle each, whose vehicles go round on small circles of their own."""
    placed = []
    for i in range(1, vehicles + 1):
        line: list[int] = []
        level = i.bit_length() - 1
        while len(line) < min(seen, level):
            line.append((line[-1] if line else i) // 2)
        width = 2**level
        angle = 2.0 * math.pi * (i - width + 0.5) / width
        reach = 9.0 * level + (6.0 if level == 0 else 0.0)
        x, y = reach * math.cos(angle), reach * math.sin(angle)
        motion = Round(0.5, 0.5 / (2.0 + i % 3) * (-1) ** i)
        placed.append(Placed((x, y, 2.0 + 0.5 * (i % 4)), angle, motion, _filled(sorted(line), i)))
    return placed


def random_graph(vehicles: int, seen: int, seed: int) -> list[Placed]:
    """Return vehicles in random places of a square, on circles of 3 to 8 m, each measuring random ones before it."""
    random, half, placed = np.random.default_rng(seed), 3.0 * math.sqrt(vehicles) + 5.0, []
    places: list[np.ndarray] = []
    while len(places) < vehicles:
        place = random.uniform(-half, half, 2)
        if all(np.linalg.norm(place - other) > 3.0 for other in places):
            places.append(place)
    for i, (x, y) in enumerate(places):
        pool = [*LANDMARKS, *(f"vehicle_{j + 1}" for j in range(i))]
        drawn = random.choice(len(pool), min(len(pool), max(seen, TARGETS if i == 0 else 1)), replace=False)
        speed, radius, side = random.uniform(0.4, 0.7), random.uniform(3.0, 8.0), random.choice([-1.0, 1.0])
        z, yaw = random.uniform(1.5, 4.0), random.uniform(-math.pi, math.pi)
        motion = Round(round(float(speed), 3), round(float(side * speed / radius), 5))
        names = tuple(pool[n] for n in sorted(drawn.tolist()))
        placed.append(Placed((float(x), float(y), float(z)), float(yaw), motion, names))
    return placed


def ring(vehicles: int, seen: int) -> list[Placed]:
    """Return vehicles that follow one another on a circle, each with landmarks besides."""
    radius, placed = max(8.0, 3.0 * vehicles / (2.0 * math.pi)), []
    for i in range(vehicles):
        angle = 2.0 * math.pi * i / vehicles
        leaders = sorted((i + n) % vehicles + 1 for n in range(1, seen + 1))
        position = (radius * math.cos(angle), radius * math.sin(angle), 2.0 + 0.5 * (i % 3))
        placed.append(Placed(position, angle + math.pi / 2, Round(0.5, 0.5 / radius), _filled(leaders, i)))
    return placed


MOST_VEHICLES = 64
"""Identities fit the 64 bits of the dependence mask in messages of `robust`."""


class Option(NamedTuple):
    """A whole number that a scene takes."""

    least: int
    most: int
    default: int


class Scene(NamedTuple):
    """A kind of scene."""

    about: str
    build: Callable[..., Sequence[Placed]]
    """Takes the options by name."""
    options: Mapping[str, Option]


def _vehicles(default: int, least: int = 2) -> Option:
    return Option(least, MOST_VEHICLES, default)


_SEEN = Option(1, 8, 3)

SCENES: Mapping[str, Scene] = {
    "lane": Scene(
        "A lane, each measures those in front.",
        lane,
        {"vehicles": _vehicles(8), "seen": _SEEN},
    ),
    "roots": Scene(
        "Two streets that measure across.",
        roots,
        {"vehicles": _vehicles(10, 3)},
    ),
    "tree": Scene(
        "A tree, each measures those above.",
        tree,
        {"vehicles": _vehicles(15), "seen": _SEEN},
    ),
    "random": Scene(
        "A random acyclic graph.",
        random_graph,
        {"vehicles": _vehicles(12), "seen": _SEEN, "seed": Option(0, 2**31 - 1, 0)},
    ),
    "ring": Scene(
        "A circle, each measures those in front.",
        ring,
        {"vehicles": _vehicles(5, 3), "seen": Option(1, 2, 1)},
    ),
}
"""By name."""


class Request(NamedTuple):
    """A scene with every option."""

    name: str
    """As it was asked for."""
    kind: str
    options: Mapping[str, int]

    @property
    def vehicles(self) -> Sequence[Placed]:
        """Its vehicles in order."""
        return SCENES[self.kind].build(**self.options)


def scene_rows() -> list[dict[str, str]]:
    """Return the rows of `list scenes`."""
    return [
        {"name": f"{kind}:N", "options": ", ".join(map(_briefly, scene.options.items())), "about": scene.about}
        for kind, scene in SCENES.items()
    ]


def _briefly(option: tuple[str, Option]) -> str:
    name, (least, most, _) = option
    return f"{least}..{most} {name}" if most < 1000 else name


def read_request(text: str) -> Request:
    """Return the scene of a name; missing options have their defaults.

    Raises:
        UnknownEnvironmentError: no such scene or option, or a number that is not allowed.
    """
    kind, _, rest = text.partition(":")
    if kind not in SCENES:
        raise UnknownEnvironmentError(f"unknown scene {shown(kind)}{suggest(kind, SCENES)}; known: {listed([*SCENES])}")
    known, given = SCENES[kind].options, {}
    for place, word in enumerate(rest.split(",") if rest.strip() else ()):
        key, equals, value = (part.strip() for part in word.partition("="))
        if not equals and place == 0:
            key, value = "vehicles", key  # lane:20
        if key not in known:
            allowed = ", ".join(f"{name} ({o.least}..{o.most})" for name, o in known.items())
            raise UnknownEnvironmentError(f"scene {kind}: unknown option {shown(key)}; allowed: {allowed}")
        if key in given:
            raise UnknownEnvironmentError(f"scene {kind}: {key} is given twice")
        given[key] = _number(kind, key, value, known[key])
    return Request(text, kind, {name: given.get(name, option.default) for name, option in known.items()})


def _number(kind: str, key: str, text: str, option: Option) -> int:
    whole = text.isascii() and text.isdigit() and len(text) < 12
    if not whole or not option.least <= int(text) <= option.most:
        raise UnknownEnvironmentError(
            f"scene {kind}: {key} = {shown(text)}, allowed are whole numbers {option.least} to {option.most}"
        )
    return int(text)


LEG = 40.0  # s in one direction of a street
LONGEST = 600.0  # s for which streets are driven to and fro

HEAD = """\
#:schema ../docs/scenario.schema.json
title = "{title}"
description = \"\"\"
{about}
Starts are up to 10 deg and 1 m off; bearings have the noise of busy_intersection_tracking.\"\"\"
source = "made by: coopenv scene {name}"
horizon = 50.0 # of at most {longest:g} s, after which vehicles that drive to and fro stand still

[rates]
camera = 60.0
odometry = 60.0
decision = 10.0

[camera]
model = "omnidirectional"
orientation = "body"

[noise]
velocity = 0.1          # m/s
angular_velocity = 0.01 # rad/s
odometry_rate = "sample"
bearing.model = "isotropic"
bearing.scale = 0.002886751345948129 # rad: 0.005 / sqrt(3)
bearing.rate = "sample"

[topology]
mode = "fixed"
acyclic = {acyclic}

[observer]
k = 1.0
q = 10.0
V = [0.1, 1.0]
P0 = [1.0, 100.0]

[observation]
position_scale = {scale:.0f}.0
velocity_scale = 2.0
angular_velocity_scale = 1.0
"""

DEFAULTS = """
[vehicle_defaults]
initial_estimate.orientation_angle = 0.17453292519943295 # rad: up to 10 degrees about any axis
initial_estimate.position_radius = 1.0 # m
"""


def scene_text(name: str) -> str:
    """Return the scenario file of a scene such as `lane:20`.

    Raises:
        UnknownEnvironmentError: no such scene or option, or a number that is not allowed.
    """
    request = read_request(name)
    placed, options = request.vehicles, ", ".join(f"{key} {value}" for key, value in request.options.items())
    head = HEAD.format(
        title=f"{request.kind.capitalize()}: {options}",
        about=SCENES[request.kind].about,
        name=f"{request.kind}:" + ",".join(f"{key}={value}" for key, value in request.options.items()),
        longest=LONGEST,
        acyclic=str(request.kind != "ring").lower(),
        scale=max(40.0, *(abs(x) for vehicle in placed for x in vehicle.position)),
    )
    landmarks = "".join(f'\n[[landmarks]]\nname = "{n}"\nposition = {_vector(p)}\n' for n, p in LANDMARKS.items())
    return head + landmarks + DEFAULTS + "".join(map(_vehicle, placed))


def _vehicle(placed: Placed) -> str:
    names = ", ".join(f'"{name}"' for name in placed.neighbours)
    yaw = f"initial_pose.yaw = {placed.yaw:.6g}\n" if placed.yaw else ""
    return (
        f"\n[[vehicles]]\ninitial_pose.position = {_vector(placed.position)}\n{yaw}"
        f"motion = {_motion(placed)}\nneighbours = [{names}]\n"
    )


def _motion(placed: Placed) -> str:
    motion = placed.motion
    if not isinstance(motion, Straight):
        twist = f"linear = [{motion.speed:.6g}, 0.0, 0.0], angular = [0.0, 0.0, {motion.turn:.6g}]"
        return f'{{ kind = "constant", {twist} }}'
    back = tuple(-x for x in motion.velocity)
    legs = [motion.velocity if n % 2 == 0 else back for n in range(round(LONGEST / LEG))]
    rows = ",\n".join(f"  {{ duration = {LEG}, linear = {_vector(leg)} }}" for leg in legs)
    return f'{{ kind = "segments", segments = [\n{rows},\n] }}'


def _vector(values: Sequence[float]) -> str:
    return f"[{', '.join(repr(round(float(x), 4) + 0.0) for x in values)}]"


__all__ = ["SCENES", "scene_rows", "scene_text"]
