"""Growth of the cost of a step with vehicles, landmarks and worlds."""

from __future__ import annotations

import math
import tomllib
import warnings
from dataclasses import asdict, dataclass

import numpy as np

from benchmarks.speed.cases import COOPENV, Case
from benchmarks.speed.measure import Result
from coopenv.base.errors import ScenarioWarning
from coopenv.scenario import Scenario, parse_scenario, scenario_path
from coopenv.scenario.files import apply_vehicle_defaults

BASE = "busy_intersection"
VEHICLES, LANDMARKS = 5, 3
"""Held while something else grows."""
GAP, SPACING = 3.0, 15.0
"""m between vehicles that follow one another, and between those on a grid."""
WORLDS = 64
"""Worlds while vehicles or landmarks grow: enough for the arithmetic to outweigh the call."""
NEARBY_VEHICLES = 64
"""Held while the landmarks of one world grow."""
RANGE, MOST_NEARBY = 30.0, 64
"""m of cameras and radio, and the vehicles and landmarks within it at most, where vehicles keep those nearby alone."""
SIZES: dict[str, tuple[int, ...]] = {
    "vehicles": (2, 4, 8, 16, 32, 64),
    "nearby": (64, 128, 256, 512, 1024, 2048, 4096),
    "robust": (64, 128, 256, 512, 1024),
    "landmarks": (3, 6, 12, 24, 48, 64),
    "map": (64, 256, 1024, 4096, 10_000),
    "worlds": (1, 4, 16, 64, 256, 1024, 4096, 16384, 65536),
}
QUICK_SIZES: dict[str, tuple[int, ...]] = {
    "vehicles": (2, 8, 32),
    "nearby": (64, 256),
    "robust": (64, 128),
    "landmarks": (3, 12, 48),
    "map": (64, 1024),
    "worlds": (1, 64, 4096),
}


@dataclass(frozen=True)
class Sweep:
    """One quantity that grows, all else held."""

    quantity: str
    """vehicles, landmarks or worlds."""
    sensed: bool
    """Everyone looks for everyone before it; or else each measures three fixed neighbours."""
    sizes: tuple[int, ...]
    nearby: bool = False
    """A grid of vehicles and landmarks with ranges, in one world: its density stays the same."""
    observer: str = "riccati"

    @property
    def kind(self) -> str:
        """Sensing of the vehicles, and the observer if it differs from the other sweeps'."""
        kind = "three neighbours" if not self.sensed else "nearby" if self.nearby else "sensed"
        return kind if self.observer == "riccati" else f"{kind}, {self.observer}"

    @property
    def label(self) -> str:
        """Name for people."""
        return f"{self.quantity}, {self.kind}"

    def cases(self) -> list[Case]:
        """Return one case per size, on one thread."""
        cases = []
        for size in self.sizes:
            shape = {"vehicles": VEHICLES, "landmarks": LANDMARKS, "worlds": WORLDS}
            if self.nearby:
                shape = {"vehicles": NEARBY_VEHICLES, "landmarks": size, "worlds": 1}
            shape[self.quantity] = size
            worlds = shape.pop("worlds")
            given = {"sensed": self.sensed, "nearby": self.nearby, "observer": self.observer}
            options = {"growth": {**shape, **given}}
            cases.append(Case(self.label, COOPENV.name, worlds, shape["vehicles"], options=options))
        return cases


def sweeps(quick: bool = False) -> list[Sweep]:
    """Return what is measured."""
    sizes = QUICK_SIZES if quick else SIZES
    return [
        Sweep("vehicles", True, sizes["vehicles"]),
        Sweep("vehicles", False, sizes["vehicles"]),
        Sweep("vehicles", True, sizes["nearby"], nearby=True),
        Sweep("vehicles", True, sizes["robust"], nearby=True, observer="robust"),
        Sweep("landmarks", True, sizes["landmarks"]),
        Sweep("landmarks", True, sizes["map"], nearby=True),
        Sweep("worlds", True, sizes["worlds"]),
    ]


def grid(count: int) -> list[tuple[float, float]]:
    """Return the places of a square grid about the origin, m."""
    columns = math.ceil(math.sqrt(count))
    return [(SPACING * (i % columns - columns // 2), SPACING * (i // columns - columns // 2)) for i in range(count)]


def growth_scenario(
    vehicles: int, landmarks: int, sensed: bool, nearby: bool = False, observer: str = "riccati"
) -> Scenario:
    """Return the busy intersection with other numbers of vehicles (two columns) and landmarks (on a circle).

    With `nearby` both stand on a grid and have ranges, and vehicles drive in circles.
    """
    raw = apply_vehicle_defaults(tomllib.loads(scenario_path(BASE).read_text(encoding="utf-8")))
    names = [f"L{i}" for i in range(1, landmarks + 1)]
    angles = [2 * math.pi * i / landmarks for i in range(landmarks)]
    raw["landmarks"] = [
        {"name": name, "position": [6 * math.cos(a), 6 * math.sin(a), 3.0 + i % 3]}
        for i, (name, a) in enumerate(zip(names, angles, strict=True))
    ]
    raw["topology"] = {"mode": "sensed" if sensed else "fixed"}
    raw["observer"]["name"] = observer
    template = raw["vehicles"][0]
    raw["vehicles"] = []
    for i in range(vehicles):
        back = 16.0 + GAP * (i // 2)
        position, direction = ([-2.0, -back, 2.5], [0.0, 0.5, 0.0]) if i % 2 == 0 else ([-back, 2.0, 3.0], [0.5, 0, 0])
        vehicle = {
            **template,
            "initial_pose": {"position": position},
            "initial_estimate": {**template["initial_estimate"], "position": [x + 2.0 for x in position]},
            "motion": {"kind": "constant", "linear": direction},
        }
        del vehicle["neighbours"]
        if not sensed:
            vehicle["neighbours"] = names[:3] if i == 0 else [*names[:2], f"vehicle_{i}"]
        raw["vehicles"].append(vehicle)
    if nearby:
        raw["topology"] |= {"most_nearby": MOST_NEARBY, "acyclic": False}
        raw["camera"]["range"], raw["v2x"] = RANGE, {"range": RANGE, "delay": 1}
        for mark, (x, y) in zip(raw["landmarks"], grid(landmarks), strict=True):
            mark["position"] = [x + SPACING / 2, y + SPACING / 2, 3.0]
        for i, (vehicle, (x, y)) in enumerate(zip(raw["vehicles"], grid(vehicles), strict=True)):
            vehicle["initial_pose"] = {"position": [x, y, 0.5], "yaw": 2.4 * i % 6.0 - 3.0}
            vehicle["initial_estimate"] = {"position": [x + 0.5, y, 0.5]}
            vehicle["motion"] = {"kind": "constant", "linear": [1.0, 0.0, 0.0], "angular": [0.0, 0.0, 0.5]}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ScenarioWarning)
        return parse_scenario(raw, f"{BASE} with {vehicles} vehicles and {landmarks} landmarks")


@dataclass(frozen=True)
class PowerLaw:
    """cost = factor * size ** exponent."""

    exponent: float
    factor: float


@dataclass(frozen=True)
class Growth:
    """The CPU time of a step of all worlds (s) over the sizes that were measured."""

    sweep: Sweep
    sizes: list[int]
    costs: list[float]
    overall: PowerLaw
    large: PowerLaw
    """Fitted to the larger half of the sizes, where constant costs no longer count."""

    def row(self) -> dict[str, object]:
        """Return the figures as plain data."""
        return {"label": self.sweep.label, "unit": "s of CPU time per step of all worlds", **asdict(self)}


def fit_power_law(sizes: list[int], costs: list[float]) -> PowerLaw:
    """Return the least-squares line through the logarithms."""
    slope, offset = np.polyfit(np.log(sizes), np.log(costs), 1)
    return PowerLaw(float(slope), float(np.exp(offset)))


def summarise(sweep: Sweep, results: list[Result]) -> Growth | None:
    """Return a sweep's costs and fits; None when fewer than two sizes could be measured."""
    pairs = [
        (size, result.cpu_seconds_per_step)
        for size, result in zip(sweep.sizes, results, strict=True)
        if not result.problem
    ]
    if len(pairs) < 2:
        return None
    sizes, costs = [size for size, _ in pairs], [cost for _, cost in pairs]
    half = min(len(sizes) // 2, len(sizes) - 2)
    return Growth(sweep, sizes, costs, fit_power_law(sizes, costs), fit_power_law(sizes[half:], costs[half:]))
