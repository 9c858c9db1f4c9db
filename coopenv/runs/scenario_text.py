"""The setting of a scenario in words: texts, rows of fields, and the draws of every episode."""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from pydantic import BaseModel

from coopenv.base.errors import listed
from coopenv.base.format import number
from coopenv.base.sections import Section
from coopenv.scenario.bodies import (
    ConstantMotion,
    DrivenMotion,
    InitialEstimate,
    InitialPose,
    SegmentMotion,
    TrafficMotion,
    Vehicle,
    WaypointMotion,
)
from coopenv.scenario.difficulty import PARAMETERS
from coopenv.scenario.schema import Scenario, neighbour_sets
from coopenv.scenario.sensing import Camera

MANY_LANDMARKS = 4  # from this number on, `all landmarks` stands for their names


def vector(values: Sequence[float]) -> str:
    """Return `(1, 2, 3)`."""
    return f"({', '.join(number(v) for v in values)})"


def setting(value: Any) -> str:
    """Return a setting much as the TOML file would write it; `none` for a limit that is not there."""
    if value is None:
        return "none"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return number(value)
    if isinstance(value, tuple):
        return f"[{', '.join(setting(v) for v in value)}]"
    if isinstance(value, dict):
        return ", ".join(f"{key} = {setting(v)}" for key, v in value.items())
    return str(value)


def turn(quaternion_wxyz: Sequence[float]) -> str:
    """Return a rotation as `90 deg about z`, or about the axis' coordinates."""
    w, *xyz = quaternion_wxyz if quaternion_wxyz[0] >= 0.0 else [-part for part in quaternion_wxyz]
    sine = math.hypot(*xyz)
    angle = 2.0 * math.atan2(sine, w)
    if angle < 1e-9:
        return "0 deg"
    axis = np.array(xyz) / sine
    for name, unit in zip("xyz", np.eye(3), strict=True):
        if abs(axis @ unit) > 1.0 - 1e-9:
            return f"{number(math.degrees(math.copysign(angle, axis @ unit)))} deg about {name}"
    return f"{number(math.degrees(angle))} deg about {vector(axis.round(3).tolist())}"


def orientation(yaw: float | None, quaternion_wxyz: Sequence[float] | None) -> str | None:
    """Return an absolute orientation in words; None when neither is given."""
    if yaw is not None:
        return f"yaw {number(math.degrees(yaw))} deg"
    return None if quaternion_wxyz is None else f"turned {turn(quaternion_wxyz)}"


def lines(*facts: object) -> str:
    """Return one line per fact that is there."""
    return "\n".join(str(fact) for fact in facts if fact)


def start(vehicle: Vehicle) -> str:
    """Return the start of a vehicle, one line per fact."""
    if isinstance(vehicle.motion, WaypointMotion):
        return vector(vehicle.motion.waypoints[0].position)
    if vehicle.initial_pose is None and not vehicle.routes:
        return "drawn with the traffic"
    pose = vehicle.initial_pose or InitialPose()
    return lines(
        "start of its route" if pose.position is None else vector(pose.position),
        pose.position and (orientation(pose.yaw, pose.quaternion_wxyz) or "yaw 0 deg"),
        any(pose.position_spread) and f"+- {vector(pose.position_spread)}",
        pose.yaw_spread and f"+- {number(math.degrees(pose.yaw_spread))} deg",
        vehicle.entry and f"appears after {' to '.join(map(number, vehicle.entry))} s",
    )


def estimate(belief: InitialEstimate) -> str:
    """Return the observer's estimate at t = 0, one line per fact."""
    angle = belief.orientation_angle
    return lines(
        "true position" if belief.position is None else vector(belief.position),
        any(belief.position_offset) and f"+ {vector(belief.position_offset)}",
        belief.position_radius and f"within {number(belief.position_radius)} m",
        orientation(belief.yaw, belief.quaternion_wxyz) or "true orientation",
        belief.orientation_offset_wxyz != (1.0, 0.0, 0.0, 0.0) and f"off by {turn(belief.orientation_offset_wxyz)}",
        "turned at random, over SO(3)"
        if isinstance(angle, str)
        else angle and f"within {number(math.degrees(angle))} deg",
    )


def motion(moves: Any) -> str:
    """Return a motion in words."""
    if isinstance(moves, ConstantMotion):
        return f"keeps {twist(moves.linear, moves.angular)}"
    if isinstance(moves, SegmentMotion):
        time = sum(segment.duration for segment in moves.segments)
        speed = max(math.hypot(*segment.linear) for segment in moves.segments)
        return f"{len(moves.segments)} held twists over {number(time)} s, up to {number(speed)} m/s"
    if isinstance(moves, WaypointMotion):
        return f"spline through {len(moves.waypoints)} waypoints over {number(moves.waypoints[-1].time)} s"
    if isinstance(moves, DrivenMotion):
        return f"driven by actions, starts at {number(moves.initial_speed)} m/s"
    if isinstance(moves, TrafficMotion):
        return "driven by the traffic"
    return "stands still"


def stages(moves: Any) -> Iterator[tuple[str, str]]:
    """Yield (time, event) of a motion by segments or waypoints, in order; nothing for other motions."""
    if isinstance(moves, SegmentMotion):
        begin = 0.0
        for segment in moves.segments:
            end = begin + segment.duration
            moving = any((*segment.linear, *segment.angular))
            yield f"{number(begin)}-{number(end)}", twist(segment.linear, segment.angular) if moving else "rests"
            begin = end
        yield f"{number(begin)}-", "rests"
    elif isinstance(moves, WaypointMotion):
        for waypoint in moves.waypoints:
            yield number(waypoint.time), f"at {vector(waypoint.position)}"


def twist(linear: Sequence[float], angular: Sequence[float]) -> str:
    """Return a body twist as `0.6 m/s to the left`, or by its components."""
    directions = (("forward", "backward"), ("to the left", "to the right"), ("up", "down"))
    moving = [axis for axis, value in enumerate(linear) if value]
    if len(moving) == 1:
        value = linear[moving[0]]
        text = f"{number(abs(value))} m/s {directions[moving[0]][value < 0]}"
    else:
        text = f"{vector(linear)} m/s" if moving else "0 m/s"
    return f"{text}, turning at {vector(angular)} rad/s" if any(angular) else text


def vehicle_motion(vehicle: Vehicle) -> str:
    """Return a vehicle's motion and goal in words."""
    place = f"the end of its route: {' or '.join(vehicle.routes)}" if vehicle.routes else ""
    if not place and vehicle.goal is not None and vehicle.goal.position is not None:
        place = vector(vehicle.goal.position)
    goal = place and f"goal: within {number(vehicle.goal_radius)} m of {place}"
    return lines(motion(vehicle.motion), goal, not vehicle.connected and "without a radio")


def size(edges: Sequence[float]) -> str:
    """Return the size of a box, m."""
    return " x ".join(map(number, edges))


def neighbours(scenario: Scenario) -> list[str]:
    """Return, per vehicle, the names of the targets that it may measure."""
    if scenario.keeps_those_in_range:
        return ["what is in range"] * len(scenario.vehicles)
    L, result = len(scenario.landmarks), []
    for indices in neighbour_sets(scenario):
        names = [scenario.target_names[index] for index in indices]
        if L >= MANY_LANDMARKS and indices[:L] == list(range(L)):
            names = [f"all {L} landmarks", *names[L:]]
        result.append(", ".join(names) or "none")
    return result


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


IMAGE_FIELDS = ("image_size", "focal_length", "principal_point", "distortion", "undistort", "quantise")
"""Settings of a camera that matter only where it has an image, as a pinhole camera does."""


class Listing(NamedTuple):
    """A table of texts; cells may have several lines."""

    title: str
    columns: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]


def scene(scenario: Scenario, grouped: bool = True) -> Iterator[Listing]:
    """Yield the tables of vehicles, routes, landmarks and buildings, without empty tables and empty columns.

    `grouped`: whether landmarks that a group draws have rows of their own.
    """
    pairs = zip(scenario.vehicle_names, scenario.vehicles, neighbours(scenario), strict=True)
    vehicles = ((name, start(v), estimate(v.initial_estimate), vehicle_motion(v), seen) for name, v, seen in pairs)
    columns = ("vehicle", "start", "initial estimate", "motion", "may measure")
    yield from _listing("Vehicles (m)", columns, vehicles)
    routes = (
        (
            *(r.name, ", ".join(map(vector, r.waypoints)), f"radius {number(r.corner_radius)}"),
            lines(
                r.lateral_spread and f"shifted by +- {number(r.lateral_spread)}",
                r.wander and f"wanders by {number(r.wander)}",
                r.start_spread and f"begun along the first {number(r.start_spread)}",
            ),
        )
        for r in scenario.routes
    )
    yield from _listing("Routes (m)", ("route", "waypoints", "corners", "drawn"), routes)
    landmarks = (
        (
            mark.name,
            lines(
                f"drawn by group {mark.group}" if mark.group else vector(mark.position),
                any(mark.position_spread) and f"+- {vector(mark.position_spread)}",
                mark.presence < 1.0 and f"there with {number(100.0 * mark.presence)} %",
            ),
            *(motion(mark.motion), size(mark.body.size) if mark.body else "none"),
        )
        for mark in scenario.landmarks
        if grouped or mark.group is None
    )
    yield from _listing("Landmarks (m)", ("landmark", "position", "motion", "body"), landmarks)
    groups = (
        (
            *(group.name, str(group.count)),
            lines(
                *(f"{vector(box.center)} +- {vector(box.half)}" for box in group.boxes),
                *(f"{vector(line.start)} to {vector(line.end)}" for line in group.lines),
            ),
            " to ".join(map(number, group.height)),
        )
        for group in scenario.landmark_groups
    )
    yield from _listing("Groups of landmarks (m)", ("group", "landmarks", "drawn in", "height"), groups)
    named = zip(scenario.vehicle_names, scenario.vehicles, strict=True)
    moving = [*((name, v.motion) for name, v in named), *((mark.name, mark.motion) for mark in scenario.landmarks)]
    rows = (("" if i else name, *stage) for name, moves in moving for i, stage in enumerate(stages(moves)))
    yield from _listing("Stages of motion (s)", ("who", "time", "motion"), rows)
    boxes = (
        (box.name, vector(box.center), size(box.size), f"{number(math.degrees(box.yaw))} deg")
        for box in scenario.obstacles
    )
    yield from _listing("Buildings (m)", ("building", "centre", "size", "yaw"), boxes)


def _listing(title: str, columns: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> Iterator[Listing]:
    """Yield a table without empty columns; nothing where there are no rows."""
    kept = [(name, cells) for name, *cells in zip(columns, *rows, strict=True) if any(cells)]
    if kept:
        names, *cells = zip(*((name, *column) for name, column in kept), strict=True)
        yield Listing(title, names, cells)


def settings(part: BaseModel, prefix: str = "") -> Iterator[tuple[str, str, str, bool]]:
    """Yield (dotted key, value, meaning, whether it differs from the default) of a section's fields that matter."""
    meanings = part.meanings() if isinstance(part, Section) else {}
    unused = IMAGE_FIELDS if isinstance(part, Camera) and part.model != "pinhole" else ()
    for name, info in type(part).model_fields.items():
        if name in unused:
            continue
        value = getattr(part, name)
        if isinstance(value, BaseModel):
            yield from settings(value, f"{prefix}{name}.")
        elif name == "custom":
            yield from ((f"custom.{key}", setting(row.function), row.meaning, True) for key, row in value.items())
        else:
            meaning = " ".join(meanings.get(name, "").split())
            yield f"{prefix}{name}", setting(value), meaning, value != info.get_default()
    for name, value in (part.model_extra or {}).items():
        yield f"{prefix}{name}", setting(value), "A term of one's own, see docs/terms.md", True
