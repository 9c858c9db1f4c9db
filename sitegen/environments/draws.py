"""What every world of an environment draws at a reset, in words."""

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from coopenv.base.errors import listed
from coopenv.base.format import number
from coopenv.scenario.bodies import DrivenMotion
from coopenv.scenario.difficulty import PARAMETERS
from coopenv.scenario.schema import Scenario


def graded(scenario: Scenario) -> Iterator[str]:
    """Yield one line per thing that grows with the difficulty."""
    for name, (what, _, _) in PARAMETERS.items():
        low, high = scenario.difficulty.factors(name)
        if (low, high) != (1.0, 1.0):
            yield f"a factor of {what}: {number(low)} at difficulty 0, {number(high)} at 1"


def drawn(s: Scenario) -> Iterator[str]:
    """Yield one line per thing that every world draws for itself at every reset."""
    if s.cosimulator is not None:
        yield f"roads and traffic, by {s.cosimulator.roads}"
    several = [name for name, v in zip(s.vehicle_names, s.vehicles, strict=True) if len(v.routes) > 1]
    if several:
        yield f"one of its routes, for {listed(several)}"
    yield from _spans("shift of a route to either side", s.routes, lambda r: r.lateral_spread, "m")
    yield from _spans("further deviation of a route", s.routes, lambda r: r.wander, "m")
    yield from _spans("start along a route", s.routes, lambda r: r.start_spread, "m")
    poses = [vehicle.initial_pose for vehicle in s.vehicles if vehicle.initial_pose is not None]
    yield from _spans("a vehicle's start along its own axis", poses, lambda p: p.position_spread[0], "m", "+- ")
    yield from _spans("a vehicle's start to either side", poses, lambda p: p.position_spread[1], "m", "+- ")
    yield from _spans("a vehicle's start in height", poses, lambda p: p.position_spread[2], "m", "+- ")
    yield from _spans("a vehicle's heading", poses, lambda p: math.degrees(p.yaw_spread), "deg", "+- ")
    driven = [v.motion for v in s.vehicles if isinstance(v.motion, DrivenMotion)]
    yield from _spans("a vehicle's first speed", driven, lambda m: m.initial_speed_spread, "m/s", "+- ")
    moving = [*s.vehicles, *s.landmarks]
    yield from _spans("pace of a prescribed motion", moving, lambda m: 100.0 * m.pace_spread, "%", "+- ")
    yield from _absent("a vehicle", s.vehicles)
    alike: dict[tuple[int, str], list[str]] = {}
    for group in s.landmark_groups:
        sort, count = ("areas", len(group.boxes)) if group.boxes else ("lines", len(group.lines))
        where = f"{count} {sort}" if count > 1 else f"one {sort.removesuffix('s')}"
        alike.setdefault((group.count, where), []).append(f"`{group.name}`")
    for (count, where), names in alike.items():
        yield f"the places of {count} landmarks {listed(names)}, over {where}"
    yield from _spans("place of a landmark along an axis", s.landmarks, lambda m: max(m.position_spread), "m", "+- ")
    yield from _absent("a landmark", s.landmarks)
    beliefs = [vehicle.initial_estimate for vehicle in s.vehicles]
    yield from _spans("offset of an initial estimate", beliefs, lambda b: b.position_radius, "m")
    angles = {belief.orientation_angle for belief in beliefs}
    if "uniform" in angles:
        yield "turn of an initial estimate: over SO(3)"
    yield from _spans("turn of an initial estimate", [*angles - {"uniform"}], math.degrees, "deg")
    noises = [noise for noise in s.noises if noise.enabled]
    cameras = [camera for camera, noise in zip(s.cameras, s.noises, strict=True) if noise.enabled]
    deviation = "standard deviation "
    yield from _spans("scale error of the odometry", noises, lambda n: 100.0 * n.odometry_scale, "%", deviation)
    yield from _spans("bias of the gyro", noises, lambda n: math.degrees(np.max(n.gyro_bias)), "deg/s", deviation)
    yield from _spans("turn of a camera", cameras, lambda c: math.degrees(c.extrinsics_error), "deg", deviation)
    yield from _spans("offset of a camera", cameras, lambda c: c.extrinsics_position_error, "m", deviation)
    for name, (what, _, _) in PARAMETERS.items():
        low, high = s.randomisation.factors(name)
        if (low, high) != (1.0, 1.0):
            yield f"a factor of {what}: {number(low)} to {number(high)}"


def _spans(
    what: str, parts: Sequence[Any], of: Callable[[Any], float], unit: str, kind: str = "up to "
) -> Iterator[str]:
    """Yield one line on a spread, from the least to the largest value other than 0."""
    if values := sorted({float(of(part)) for part in parts} - {0.0}):
        yield f"{what}: {kind}{_range(values)} {unit}"


def _absent(what: str, parts: Sequence[Any]) -> Iterator[str]:
    if chances := sorted({part.presence for part in parts} - {1.0}):
        yield f"whether {what} is there: with {_range([100.0 * chance for chance in chances])} %"


def _range(values: Sequence[float]) -> str:
    low, high = number(values[0]), number(values[-1])
    return low if low == high else f"{low} .. {high}"
