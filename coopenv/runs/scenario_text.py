"""The setting of a scenario in words: texts, rows of fields, and what is drawn anew in every episode."""

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from pydantic import BaseModel

from coopenv.api.terms.layout import observation_layout
from coopenv.base.errors import listed
from coopenv.base.format import number
from coopenv.base.sections import Section
from coopenv.scenario.bodies import (
    Body,
    ConstantMotion,
    DrivenMotion,
    InitialEstimate,
    InitialPose,
    Landmark,
    LandmarkGroup,
    SegmentMotion,
    TrafficMotion,
    Vehicle,
    WaypointMotion,
)
from coopenv.scenario.learning import PARAMETERS
from coopenv.scenario.routes import Route
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


def start(vehicle: Vehicle) -> str:
    """Return where a vehicle starts, one line per fact."""
    if isinstance(vehicle.motion, WaypointMotion):
        return vector(vehicle.motion.waypoints[0].position)
    if vehicle.initial_pose is None and not vehicle.routes:
        return "drawn by highway-env"
    pose = vehicle.initial_pose or InitialPose()
    if pose.position is None:
        lines = ["start of its route"]
    else:
        lines = [vector(pose.position), orientation(pose.yaw, pose.quaternion_wxyz) or "yaw 0 deg"]
    if any(pose.position_spread):
        lines.append(f"+- {vector(pose.position_spread)}")
    if pose.yaw_spread:
        lines.append(f"+- {number(math.degrees(pose.yaw_spread))} deg")
    return "\n".join(lines)


def place(landmark: Landmark) -> str:
    """Return where a landmark stands, one line per fact."""
    lines = [f"drawn by group {landmark.group}" if landmark.group else vector(landmark.position)]
    if any(landmark.position_spread):
        lines.append(f"+- {vector(landmark.position_spread)}")
    if landmark.presence < 1.0:
        lines.append(f"there with {number(100.0 * landmark.presence)} %")
    return "\n".join(lines)


def drawn_route(route: Route) -> str:
    """Return how a route is drawn, one line per fact; empty where it is always the same."""
    lines = [f"shifted by +- {number(route.lateral_spread)}"] if route.lateral_spread else []
    lines += [f"wanders by {number(route.wander)}"] if route.wander else []
    lines += [f"begun along the first {number(route.start_spread)}"] if route.start_spread else []
    return "\n".join(lines)


def areas(group: LandmarkGroup) -> str:
    """Return where a group draws its landmarks, one line per area."""
    boxes = [f"{vector(box.center)} +- {vector(box.half)}" for box in group.boxes]
    return "\n".join([*boxes, *(f"{vector(line.start)} to {vector(line.end)}" for line in group.lines)])


def estimate(belief: InitialEstimate) -> str:
    """Return what the observer believes at t = 0, one line per fact."""
    lines = ["true position" if belief.position is None else vector(belief.position)]
    if any(belief.position_offset):
        lines.append(f"+ {vector(belief.position_offset)}")
    if belief.position_radius:
        lines.append(f"within {number(belief.position_radius)} m")
    lines.append(orientation(belief.yaw, belief.quaternion_wxyz) or "true orientation")
    if belief.orientation_offset_wxyz != (1.0, 0.0, 0.0, 0.0):
        lines.append(f"off by {turn(belief.orientation_offset_wxyz)}")
    if belief.orientation_angle == "uniform":
        lines.append("turned at random, over SO(3)")
    elif belief.orientation_angle:
        lines.append(f"within {number(math.degrees(belief.orientation_angle))} deg")
    return "\n".join(lines)


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
        return "driven by highway-env's traffic"
    return "stands still"


def stages(moves: Any) -> Iterator[tuple[str, str]]:
    """Yield (time, what happens) of a motion by segments or waypoints, in order; nothing for other motions."""
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
    radius = number(vehicle.goal_radius)
    if vehicle.routes:
        routes = " or ".join(vehicle.routes)
        return f"{motion(vehicle.motion)}\ngoal: within {radius} m of the end of its route: {routes}"
    if vehicle.goal is None or vehicle.goal.position is None:
        return motion(vehicle.motion)
    return f"{motion(vehicle.motion)}\ngoal: within {radius} m of {vector(vehicle.goal.position)}"


def body(box: Body | None) -> str:
    """Return a body's size, m; empty without one."""
    return "" if box is None else " x ".join(number(edge) for edge in box.size)


def neighbours(scenario: Scenario) -> list[str]:
    """Return, per vehicle, the names of the targets that it may measure."""
    L, result = len(scenario.landmarks), []
    for indices in neighbour_sets(scenario):
        names = [scenario.target_names[index] for index in indices]
        if L >= MANY_LANDMARKS and indices[:L] == list(range(L)):
            names = [f"all {L} landmarks", *names[L:]]
        result.append(", ".join(names) or "none")
    return result


def drawn(scenario: Scenario) -> Iterator[str]:
    """Yield one line per thing that every world draws for itself at every reset."""
    yield from _of_vehicles(scenario)
    yield from _of_landmarks(scenario)
    yield from _of_errors(scenario)
    for name, (what, _, _) in PARAMETERS.items():
        low, high = scenario.randomisation.factors(name)
        if (low, high) != (1.0, 1.0):
            yield f"a factor of {what}: {number(low)} to {number(high)}"


def graded(scenario: Scenario) -> Iterator[str]:
    """Yield one line per thing that grows with the difficulty."""
    for name, (what, _, _) in PARAMETERS.items():
        low, high = scenario.difficulty.factors(name)
        if (low, high) != (1.0, 1.0):
            yield f"a factor of {what}: {number(low)} at difficulty 0, {number(high)} at 1"


def _of_vehicles(s: Scenario) -> Iterator[str]:
    if s.highway is not None:
        yield f"roads and traffic, by highway-env's `{s.highway.id}`"
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
    motions = [vehicle.motion for vehicle in s.vehicles]
    yield from _spans(
        "a vehicle's first speed", motions, lambda m: getattr(m, "initial_speed_spread", 0.0), "m/s", "+- "
    )
    moving = [*s.vehicles, *s.landmarks]
    yield from _spans("pace of a prescribed motion", moving, lambda m: 100.0 * m.pace_spread, "%", "+- ")
    yield from _absent("a vehicle", s.vehicles)


def _of_landmarks(s: Scenario) -> Iterator[str]:
    for group in s.landmark_groups:
        sort, count = ("areas", len(group.boxes)) if group.boxes else ("lines", len(group.lines))
        where = f"{count} {sort}" if count > 1 else f"one {sort.removesuffix('s')}"
        yield f"the places of {group.count} landmarks `{group.name}`, over {where}"
    spread = [mark for mark in s.landmarks if any(mark.position_spread)]
    yield from _spans("place of a landmark along an axis", spread, lambda m: max(m.position_spread), "m", "+- ")
    yield from _absent("a landmark", s.landmarks)


def _of_errors(s: Scenario) -> Iterator[str]:
    beliefs = [vehicle.initial_estimate for vehicle in s.vehicles]
    yield from _spans("offset of an initial estimate", beliefs, lambda b: b.position_radius, "m")
    if any(belief.orientation_angle == "uniform" for belief in beliefs):
        yield "turn of an initial estimate: over SO(3)"
    turned = [belief for belief in beliefs if belief.orientation_angle != "uniform"]
    yield from _spans("turn of an initial estimate", turned, lambda b: math.degrees(b.orientation_angle), "deg")
    noises = [noise for noise in s.noises if noise.enabled]
    cameras = [camera for camera, noise in zip(s.cameras, s.noises, strict=True) if noise.enabled]
    deviation = "standard deviation "
    yield from _spans("scale error of the odometry", noises, lambda n: 100.0 * n.odometry_scale, "%", deviation)
    yield from _spans("bias of the gyro", noises, lambda n: math.degrees(np.max(n.gyro_bias)), "deg/s", deviation)
    yield from _spans("turn of a camera", cameras, lambda c: math.degrees(c.extrinsics_error), "deg", deviation)
    yield from _spans("offset of a camera", cameras, lambda c: c.extrinsics_position_error, "m", deviation)


def _spans(what: str, parts: Sequence[Any], of: Callable[[Any], float], unit: str, kind: str = "") -> Iterator[str]:
    """Yield one line on a spread, from the least to the largest value other than 0."""
    values = sorted({float(of(part)) for part in parts} - {0.0})
    if values:
        low, high = number(values[0]), number(values[-1])
        kind = kind or "up to "
        yield f"{what}: {kind}{high if low == high else f'{low} .. {high}'} {unit}"


def _absent(what: str, parts: Sequence[Any]) -> Iterator[str]:
    chances = sorted({part.presence for part in parts} - {1.0})
    if chances:
        low, high = (number(100.0 * chance) for chance in (chances[0], chances[-1]))
        yield f"whether {what} is there: with {low if low == high else f'{low} .. {high}'} %"


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
    marks = landmarks(scenario, grouped)
    tables = (vehicles(scenario), routes(scenario), marks, groups(scenario), motions(scenario), buildings(scenario))
    yield from (_without_empty_columns(table) for table in tables if table.rows)


def _without_empty_columns(table: Listing) -> Listing:
    kept = [i for i in range(len(table.columns)) if any(row[i] for row in table.rows)]
    rows = [tuple(row[i] for i in kept) for row in table.rows]
    return Listing(table.title, tuple(table.columns[i] for i in kept), rows)


def vehicles(scenario: Scenario) -> Listing:
    """Return one row per vehicle: start, initial estimate, motion, neighbours."""
    columns = ("vehicle", "start", "initial estimate", "motion", "may measure")
    targets_of = neighbours(scenario)
    rows = [
        (name, start(vehicle), estimate(vehicle.initial_estimate), vehicle_motion(vehicle), targets)
        for name, vehicle, targets in zip(scenario.vehicle_names, scenario.vehicles, targets_of, strict=True)
    ]
    return Listing("Vehicles (m)", columns, rows)


def routes(scenario: Scenario) -> Listing:
    """Return one row per route."""
    rows = []
    for route in scenario.routes:
        points = ", ".join(vector(point) for point in route.waypoints)
        rows.append((route.name, points, f"radius {number(route.corner_radius)}", drawn_route(route)))
    return Listing("Routes (m)", ("route", "waypoints", "corners", "drawn"), rows)


def landmarks(scenario: Scenario, grouped: bool = True) -> Listing:
    """Return one row per landmark, those of groups included or not."""
    rows = [
        (mark.name, place(mark), motion(mark.motion), body(mark.body) or "none")
        for mark in scenario.landmarks
        if grouped or mark.group is None
    ]
    return Listing("Landmarks (m)", ("landmark", "position", "motion", "body"), rows)


def groups(scenario: Scenario) -> Listing:
    """Return one row per group of landmarks."""
    rows = [
        (group.name, str(group.count), areas(group), " to ".join(number(z) for z in group.height))
        for group in scenario.landmark_groups
    ]
    return Listing("Groups of landmarks (m)", ("group", "landmarks", "drawn in", "height"), rows)


def motions(scenario: Scenario) -> Listing:
    """Return one row per stage of every motion that is prescribed stage by stage."""
    moving = [*(v.motion for v in scenario.vehicles), *(m.motion for m in scenario.landmarks)]
    names = [*scenario.vehicle_names, *(m.name for m in scenario.landmarks)]
    rows = [
        ("" if i else name, time, stage)
        for name, motion in zip(names, moving, strict=True)
        for i, (time, stage) in enumerate(stages(motion))
    ]
    return Listing("Stages of motion (s)", ("who", "time", "motion"), rows)


def buildings(scenario: Scenario) -> Listing:
    """Return one row per building."""
    rows = []
    for obstacle in scenario.obstacles:
        yaw = orientation(obstacle.yaw, None) or ""
        size = " x ".join(number(edge) for edge in obstacle.size)
        rows.append((obstacle.name, vector(obstacle.center), size, yaw.removeprefix("yaw ")))
    return Listing("Buildings (m)", ("building", "centre", "size", "yaw"), rows)


def observation(scenario: Scenario) -> Listing:
    """Return one row per field of the flat observation."""
    layout, rows = observation_layout(scenario), []
    for name, field in layout.items():
        shape, part = "x".join(map(str, field.shape)), f"{field.start}:{field.stop}"
        meaning = f"{field.meaning}; center {number(field.center)}" if field.center else field.meaning
        rows.append((name, part, shape, field.unit, number(field.scale), meaning))
    title = f"Observation: {layout.size} entries per vehicle, each (value - center) / scale, clipped"
    return Listing(title, ("field", "slice", "shape", "unit", "scale", "meaning"), rows)


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
