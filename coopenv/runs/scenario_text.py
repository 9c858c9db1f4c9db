"""The setting of a scenario in words: texts and tables."""

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np
from pydantic import BaseModel

from coopenv.base.format import number
from coopenv.base.sections import Section
from coopenv.report.table import Column, Table
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
from coopenv.scenario.schema import Scenario, neighbour_sets
from coopenv.scenario.sensing import Camera
from coopenv.scenario.sensors import SensorSection

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


IMAGE_FIELDS = ("image_size", "focal_length", "principal_point", "distortion", "undistort", "quantise")
"""Settings of a camera that matter only where it has an image, as a pinhole camera does."""


def sensor_row(section: SensorSection) -> tuple[str, ...]:
    """Return a sensor's name and kind, targets, limits, noise and errors in words, one line per fact."""
    made, correlated, outages = section.made, section.correlated, section.outages
    towards = made.towards if section.towards is None else section.towards
    stds = dict.fromkeys(f"{number(std)} {unit}" for std, unit in zip(section.white, made.units, strict=True))
    unit = f" {made.units[0]}" if len({*made.units}) == 1 else ""
    return (
        section.label if section.label == section.kind else f"{section.label} ({section.kind})",
        ", ".join(section.vehicles or ["all vehicles"]),
        lines(", ".join(towards), not section.occluded and "through buildings and bodies"),
        lines(
            section.rate and f"{number(section.rate)} Hz",
            section.range and f"up to {number(section.range)} m",
            section.field_of_view and f"in {number(math.degrees(section.field_of_view))} deg",
        ),
        ", ".join(stds),
        lines(
            section.bias and f"bias {setting(section.bias)}{unit}",
            correlated.std and f"{setting(correlated.std)}{unit}, correlated over {number(correlated.time)} s",
            outages.rate and f"{number(60.0 * outages.rate)} outages a minute of {number(outages.duration)} s",
            section.miss_probability and f"{number(100.0 * section.miss_probability)} % missed",
            section.outliers.probability and f"{number(100.0 * section.outliers.probability)} % outliers",
        ),
    )


def scene(scenario: Scenario, grouped: bool = True) -> Iterator[Table]:
    """Yield the tables of vehicles, sensors, routes, landmarks and buildings, without empty tables and columns.

    `grouped`: whether landmarks that a group draws have rows of their own.
    """
    pairs = zip(scenario.vehicle_names, scenario.vehicles, neighbours(scenario), strict=True)
    vehicles = ((name, start(v), estimate(v.initial_estimate), vehicle_motion(v), seen) for name, v, seen in pairs)
    columns = ("vehicle", "start", "initial estimate", "motion", "may measure")
    yield from _listing("Vehicles (m)", columns, vehicles)
    of_sensors = ("sensor", "on", "towards", "limits", "noise", "further errors")
    yield from _listing("Sensors beside the camera", of_sensors, map(sensor_row, scenario.sensors))
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
                mark.accuracy and f"known to {number(mark.accuracy)} m",
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


WHOLE_WIDTH = 24
"""Characters at most, of a cell that is not broken into lines."""
WHOLE_COLUMNS = {"vehicle", "who", "time", "slice", "shape", "unit", "scale"}
"""Columns that are not broken into lines."""


def text_table(names: Sequence[str], rows: Sequence[Sequence[str]], title: str) -> Table:
    """Return a table of texts, whose cells may have several lines, below a title."""
    columns = []
    for i, name in enumerate(names):
        longest = max(len(line) for row in rows for line in row[i].splitlines() or [""])
        least = min(WHOLE_WIDTH, longest) if name in WHOLE_COLUMNS else None
        columns.append(Column(name, number=False, wraps=True, least=least))
    return Table(columns, {name: [row[i] for row in rows] for i, name in enumerate(names)}, title=title)


def _listing(title: str, columns: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> Iterator[Table]:
    """Yield a table without empty columns; nothing where there are no rows."""
    kept = [(name, cells) for name, *cells in zip(columns, *rows, strict=True) if any(cells)]
    if kept:
        names, *cells = zip(*((name, *column) for name, column in kept), strict=True)
        yield text_table(names, cells, title)


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
