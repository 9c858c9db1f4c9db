"""Parametric scenes: lanes, trees, random graphs, rings and roads of any number of vehicles."""

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from coopenv.base.errors import UnknownEnvironmentError, check_one_of, shown
from coopenv.scenario.sites import HORIZON, LANDMARKS, PlacedVehicle, Site, crossroad, road, site_of

TARGETS = 3
"""Bearings with which a pose is observable; a vehicle with fewer neighbours measures landmarks besides."""


def _filled(vehicles: Sequence[int], first: int = 0) -> tuple[str, ...]:
    """Return the names of vehicles (from 1 on) and of as many landmarks as make `TARGETS`."""
    names = list(LANDMARKS)
    some = [names[(first + n) % len(names)] for n in range(max(0, TARGETS - len(vehicles)))]
    return (*sorted(some), *(f"vehicle_{i}" for i in vehicles))


def lane(vehicles: int, seen: int) -> Iterator[PlacedVehicle]:
    """Yield a lane: 3 m from one to the next, all at one speed."""
    for k in range(vehicles):
        side, up = (0.5 * (-1) ** k, 0.3 * (k % 3)) if k else (0.0, 0.0)
        leaders = [i for i in range(k - seen + 1, k + 1) if i >= 1]
        yield PlacedVehicle((-2.0 + side, -10.0 - 3.0 * k, 2.5 + up), 0.0, (0.0, 0.5), 0.0, _filled(leaders))


def roots(vehicles: int) -> Iterator[PlacedVehicle]:
    """Yield two streets that cross, odd numbers on that to the north; speeds differ a little."""
    yield PlacedVehicle((-2.0, -16.0, 2.5), 0.0, (0.0, 0.6), 0.0, tuple(LANDMARKS))
    yield PlacedVehicle((-17.0, 2.0, 3.0), 0.0, (0.6, 0.0), 0.0, tuple(LANDMARKS))
    for n in range(3, vehicles + 1):
        back, aside = -19.0 - 3.0 * ((n - 3) // 2), 0.3 * (-1) ** (n // 2)
        speed, z = 0.5 + 0.02 * ((n - 3) % 8), 2.0 + 0.5 * (n % 4)
        neighbours = _filled({3: (1, 2), 4: (1, 3)}.get(n, (n - 4, n - 3, n - 2)), n - 2)
        if n % 2 == 1:
            yield PlacedVehicle((-2.0 + aside, back, z), 0.0, (0.0, speed), 0.0, neighbours)
        else:
            yield PlacedVehicle((back, 2.0 + aside, z), 0.0, (speed, 0.0), 0.0, neighbours)


def tree(vehicles: int, seen: int) -> Iterator[PlacedVehicle]:
    """Yield a binary tree, a level of it on a circle each, whose vehicles go round on small circles of their own."""
    for i in range(1, vehicles + 1):
        level = i.bit_length() - 1
        leaders = sorted(i >> up for up in range(1, min(seen, level) + 1))
        angle = 2.0 * math.pi * (i - 2**level + 0.5) / 2**level
        reach = 9.0 * level + (6.0 if level == 0 else 0.0)
        position = (reach * math.cos(angle), reach * math.sin(angle), 2.0 + 0.5 * (i % 4))
        yield PlacedVehicle(position, angle, (0.5, 0.0), 0.5 / (2.0 + i % 3) * (-1) ** i, _filled(leaders, i))


def random_graph(vehicles: int, seen: int, seed: int) -> Iterator[PlacedVehicle]:
    """Yield vehicles in random places of a square, on circles of 3 to 8 m, each measuring random ones before it."""
    random, half = np.random.default_rng(seed), 3.0 * math.sqrt(vehicles) + 5.0
    places = np.empty((0, 2))
    while len(places) < vehicles:
        place = random.uniform(-half, half, 2)
        if (np.linalg.norm(places - place, axis=1) > 3.0).all():
            places = np.vstack([places, place])
    for i, (x, y) in enumerate(places):
        pool = [*LANDMARKS, *(f"vehicle_{j + 1}" for j in range(i))]
        drawn = random.choice(len(pool), min(len(pool), max(seen, TARGETS if i == 0 else 1)), replace=False)
        speed, radius, side = random.uniform(0.4, 0.7), random.uniform(3.0, 8.0), random.choice([-1.0, 1.0])
        z, yaw = random.uniform(1.5, 4.0), random.uniform(-math.pi, math.pi)
        names = tuple(pool[n] for n in sorted(drawn.tolist()))
        yield PlacedVehicle((x, y, z), yaw, (round(speed, 3), 0.0), round(side * speed / radius, 5), names)


def ring(vehicles: int, seen: int) -> Iterator[PlacedVehicle]:
    """Yield vehicles that follow one another on a circle, each with landmarks besides."""
    radius = max(8.0, 3.0 * vehicles / (2.0 * math.pi))
    for i in range(vehicles):
        angle = 2.0 * math.pi * i / vehicles
        leaders = sorted((i + n) % vehicles + 1 for n in range(1, seen + 1))
        position = (radius * math.cos(angle), radius * math.sin(angle), 2.0 + 0.5 * (i % 3))
        yield PlacedVehicle(position, angle + math.pi / 2, (0.5, 0.0), 0.5 / radius, _filled(leaders, i))


MOST_VEHICLES, MOST_SENSED = 4096, 64
"""Most vehicles of scenes with listed neighbours, and of other scenes."""


class Option(NamedTuple):
    """A number that a scene takes, a whole one unless its default is a float."""

    least: int
    most: int
    default: float

    def value(self, text: str) -> float | None:
        """Return the number of a text; None: it is not allowed."""
        whole = isinstance(self.default, int)
        if not (WHOLE if whole else DECIMAL).fullmatch(text):
            return None
        value = int(text) if whole else float(text)
        return value if self.least <= value <= self.most else None

    @property
    def allowed(self) -> str:
        """The allowed numbers in words."""
        return f"{'whole ' if isinstance(self.default, int) else ''}numbers {self.least} to {self.most}"


WHOLE, DECIMAL = re.compile(r"[0-9]{1,11}"), re.compile(r"[0-9]{1,11}(\.[0-9]{1,11})?")


class Scene(NamedTuple):
    """A kind of scene."""

    about: str
    build: Callable[..., Site | Iterator[PlacedVehicle]]
    """Takes the options by name."""
    options: Mapping[str, Option]


_SEEN = Option(1, 8, 3)

SCENES: Mapping[str, Scene] = {
    "lane": Scene(
        "A lane, each measures those in front.", lane, {"vehicles": Option(2, MOST_VEHICLES, 8), "seen": _SEEN}
    ),
    "roots": Scene("Two streets that measure across.", roots, {"vehicles": Option(3, MOST_VEHICLES, 10)}),
    "tree": Scene(
        "A tree, each measures those above.", tree, {"vehicles": Option(2, MOST_VEHICLES, 15), "seen": _SEEN}
    ),
    "random": Scene(
        "A random acyclic graph.",
        random_graph,
        {"vehicles": Option(2, MOST_VEHICLES, 12), "seen": _SEEN, "seed": Option(0, 2**31 - 1, 0)},
    ),
    "ring": Scene(
        "A circle, each measures those in front.",
        ring,
        {"vehicles": Option(3, MOST_VEHICLES, 5), "seen": Option(1, 2, 1)},
    ),
    "road": Scene(
        "A road at speed, with posts and signs.",
        road,
        {"vehicles": Option(2, MOST_SENSED, 8), "speed": Option(1, 50, 25.0), "lanes": Option(1, 2, 2)},
    ),
    "crossroad": Scene(
        "Two roads that cross between buildings.",
        crossroad,
        {"vehicles": Option(2, MOST_SENSED, 8), "speed": Option(1, 50, 10.0)},
    ),
}
"""Scenes by name."""


def scene_rows() -> list[dict[str, str]]:
    """Return the rows of `list scenes`."""
    rows = []
    for kind, scene in SCENES.items():
        options = [f"{o.least}..{o.most} {name}" if o.most < 1000 else name for name, o in scene.options.items()]
        rows.append({"name": f"{kind}:N", "options": ", ".join(options), "about": scene.about})
    return rows


def _options(kind: str, text: str) -> dict[str, float]:
    """Return every option of a scene as it is given behind the colon; missing ones have their defaults."""
    known, given = SCENES[kind].options, {}
    for place, word in enumerate(text.split(",") if text.strip() else ()):
        key, equals, value = (part.strip() for part in word.partition("="))
        if not equals and place == 0:
            key, value = "vehicles", key  # lane:20
        if key not in known:
            allowed = ", ".join(f"{name} ({o.least}..{o.most})" for name, o in known.items())
            raise UnknownEnvironmentError(f"scene {kind}: unknown option {shown(key)}; allowed: {allowed}")
        if key in given:
            raise UnknownEnvironmentError(f"scene {kind}: {key} is given twice")
        number = known[key].value(value)
        if number is None:
            raise UnknownEnvironmentError(f"scene {kind}: {key} = {shown(value)}, allowed are {known[key].allowed}")
        given[key] = number
    return {name: given.get(name, option.default) for name, option in known.items()}


LEG = 40.0  # s in one direction of a street
LONGEST = 600.0  # s for which streets are driven to and fro

HEAD = """\
#:schema ../docs/scenario.schema.json
title = "{title}"
description = \"\"\"
{about}
Starts are up to 10 deg and 1 m off; bearings have the noise of busy_intersection_tracking.\"\"\"
source = "made by: coopenv scene {name}"
horizon = {horizon:.1f} # {after}

{sensors}

[noise]
velocity = 0.1          # m/s
angular_velocity = 0.01 # rad/s
odometry_rate = "sample"
bearing.model = "isotropic"
bearing.scale = 0.002886751345948129 # rad: 0.005 / sqrt(3)
bearing.rate = "sample"

[topology]
mode = "{mode}"
acyclic = {acyclic}{nearby}

[observer]
k = 1.0
q = 10.0
V = [0.1, 1.0]
P0 = [1.0, 100.0]

[observation]
position_scale = {scale:.0f}.0
velocity_scale = {velocity:.1f}
angular_velocity_scale = 1.0
"""

FIXED = """\
[rates]
camera = 60.0
odometry = 60.0
decision = 10.0

[camera]
model = "omnidirectional"
orientation = "body\""""

SENSED = """\
[rates]
camera = 10.0
odometry = 100.0
decision = 10.0

[camera]
model = "omnidirectional"
orientation = "body"
position = [0.5, 0.0, 1.3] # m, behind the windscreen
range = {range}"""

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
    kind, _, rest = name.partition(":")
    check_one_of("unknown scene", kind, SCENES, UnknownEnvironmentError)
    scene, options = SCENES[kind], _options(kind, rest)
    site = site_of(scene.build(**options))
    listed = [len(vehicle.neighbours) for vehicle in site.vehicles]
    given = ",".join(f"{key}={value:g}" for key, value in options.items())
    head = HEAD.format(
        title=f"{kind.capitalize()}: {given.replace('=', ' ').replace(',', ', ')}",
        about=scene.about,
        name=f"{kind}:{given}",
        horizon=HORIZON,
        after=f"of at most {LONGEST:g} s, after which vehicles that drive to and fro stand still"
        if site.range is None
        else "after which the landmarks end",
        sensors=FIXED if site.range is None else SENSED.format(range=site.range),
        mode="fixed" if site.range is None else "sensed",
        acyclic=str(kind != "ring").lower(),
        nearby=f"\nmost_nearby = {max(listed)}" if len(listed) > MOST_SENSED else "",
        scale=max(40.0, *(abs(x) for vehicle in site.vehicles for x in vehicle.position)),
        velocity=max(2.0, *(math.hypot(*vehicle.velocity) for vehicle in site.vehicles)),
    )
    return head + "".join(_surroundings(site)) + DEFAULTS + "".join(map(_vehicle, site.vehicles))


def _surroundings(site: Site) -> Iterator[str]:
    """Yield map origin, roads, buildings and landmarks."""
    if any(site.origin):
        yield f"\n[map]\norigin = {_vector(*site.origin, 0.0)}\n"
    for start, end in site.roads:
        yield f"\n[[roads]]\nstart = {_vector(*start)}\nend = {_vector(*end)}\nwidth = 8.0\n"
    for n, (center, size) in enumerate(site.buildings, 1):
        middle = _vector(*center, size[2] / 2)
        yield f'\n[[obstacles]]\nname = "building_{n}"\ncenter = {middle}\nsize = {_vector(*size)}\n'
    for name, position in site.landmarks.items():
        yield f'\n[[landmarks]]\nname = "{name}"\nposition = {_vector(*position)}\n'


def _vehicle(placed: PlacedVehicle) -> str:
    names = ", ".join(f'"{name}"' for name in placed.neighbours)
    neighbours = f"neighbours = [{names}]\n" if placed.neighbours else ""
    yaw = f"initial_pose.yaw = {placed.yaw:.6g}\n" if placed.yaw else ""
    vx, vy = placed.velocity
    body = ""
    if placed.size is not None:
        _, _, height = placed.size
        body = f"body = {{ size = {_vector(*placed.size)}, center = {_vector(0.0, 0.0, height / 2)} }}\n"
        body += f"marker = {_vector(0.0, 0.0, 1.0)}\n"
    if placed.turn or placed.size:
        turn = f", angular = [0.0, 0.0, {placed.turn:.6g}]" if placed.turn else ""
        motion = f'{{ kind = "constant", linear = {_vector(vx, vy, 0.0)}{turn} }}'
    else:
        legs = [_vector(vx * (-1) ** n, vy * (-1) ** n, 0.0) for n in range(round(LONGEST / LEG))]
        rows = ",\n".join(f"  {{ duration = {LEG}, linear = {leg} }}" for leg in legs)
        motion = f'{{ kind = "segments", segments = [\n{rows},\n] }}'
    return (
        f"\n[[vehicles]]\ninitial_pose.position = {_vector(*placed.position)}\n{yaw}"
        f"{body}motion = {motion}\n{neighbours}"
    )


def _vector(*values: float) -> str:
    return f"[{', '.join(repr(round(float(x), 4) + 0.0) for x in values)}]"
