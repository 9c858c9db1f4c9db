"""Parts of a scenario in words."""

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from coopenv.base.format import number
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
from coopenv.scenario.routes import Route
from coopenv.scenario.schema import Scenario
from coopenv.scenario.starts import neighbour_sets

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
