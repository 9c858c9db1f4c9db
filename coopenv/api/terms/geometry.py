"""Route, map and neighbours as seen from a vehicle's own estimate."""

from typing import Any

import warp as wp

from coopenv.world.camera import (
    behind_building,
    camera_to_body,
    inverse_square_of,
    marker_position,
    project,
    segment_hits_box,
)
from coopenv.world.dynamics import ARRIVED
from coopenv.world.route import place_on_route, point_on_route, route_length
from coopenv.world.v2x import fresh
from coopenv.world.warp_internals import device_function

FASTEST = wp.constant(wp.float64(2.0))
"""Largest gain of progress per time, in multiples of the top speed (the inside of a bend is shorter)."""
FORESIGHT = wp.constant(6.0)
"""Time horizon of the closest approach, s."""
FAR = wp.constant(4.0)
"""Upper bound of the closest approach, m; also its value without a message."""


@device_function
def estimate_on_route(state: Any, world: int, vehicle: int):
    """Return the place of a route nearest to the estimate; 0 without a goal.

    Returns:
        Arc length (m), offset of the estimate to the left (m), heading of the route (rad).
    """
    p = state.estimate_rotation[world, vehicle] * state.estimate_position[world, vehicle]
    s, offset, heading = place_on_route(state, world, vehicle, p[0], p[1])
    return s, offset, heading


@device_function
def estimated_progress(state: Any, world: int, vehicle: int, s: Any):
    """Return an arc length within the ends of a route, m."""
    return wp.clamp(s, s - s, route_length(state, world, vehicle))


@wp.func
def turn_between(first: Any, second: Any):
    """Return the angle from the second to the first direction, rad in [-pi, pi]."""
    return wp.atan2(wp.sin(first - second), wp.cos(first - second))


@device_function
def route_from_estimate(model: Any, state: Any, world: int, vehicle: int, s: Any, along: Any):
    """Return the route relative to the estimated pose, from its nearest arc length `s` (m) and heading `along` (rad).

    Returns:
        Heading minus the heading of the route (rad), remaining arc length (m), and the directions of the route 1, 2, 4
        and 8 steps ahead, in rad from the body's x axis to the left.
    """
    R = state.estimate_rotation[world, vehicle]
    p = R * state.estimate_position[world, vehicle]
    heading = wp.atan2(R[1, 0], R[0, 0])
    ahead = wp.vec4()
    step = model.route_step
    for k in range(4):
        x, y, _ = point_on_route(state, world, vehicle, s + step)
        ahead[k] = wp.float32(turn_between(wp.atan2(y - p[1], x - p[0]), heading))
        step = step + step
    return turn_between(heading, along), wp.max(route_length(state, world, vehicle) - s, s - s), ahead


@device_function
def furthest_so_far(state: Any, results: Any, world: int, vehicle: int):
    """Return the largest estimated progress along the present route before this decision, m; 0 on a new route."""
    last = results.furthest[world, vehicle]
    if (
        state.arrivals[world, vehicle] != results.last_arrivals[world, vehicle]
        and state.ended[world, vehicle] != ARRIVED
    ):
        last = last - last
    return last


@device_function
def metres(model: Any, state: Any, results: Any, world: int, vehicle: int, progress: Any, elapsed: wp.float64):
    """Return the metres of its route that a vehicle gains in this decision, and those that it misses.

    The missed metres are the rest of the route in the step that ends the episode without an arrival, otherwise 0.
    """
    zero = progress - progress
    last = furthest_so_far(state, results, world, vehicle)
    most = model.dynamics[vehicle].max_speed * type(progress)(FASTEST * elapsed)
    gained = wp.clamp(progress - last, zero, most)
    missed = zero
    ends = results.terminated[world, vehicle] or results.truncated[world, vehicle]
    if ends and results.alive[world, vehicle] and state.ended[world, vehicle] != ARRIVED:
        missed = wp.max(route_length(state, world, vehicle) - last - gained, zero)
    return gained, missed


@wp.struct
class Nearest:
    """A landmark in the order of the distance."""

    index: wp.int32  # -1: none
    distance: wp.float32  # m, horizontal


@device_function
def next_nearest(model: Any, state: Any, world: int, vehicle: int, last: Nearest) -> Nearest:
    """Return the landmark that follows `last` in the order of the distance from the estimate, then of the index."""
    p = state.estimate_rotation[world, vehicle] * state.estimate_position[world, vehicle]
    found = Nearest(-1, wp.float32(0.0))
    if last.index < 0 and last.distance >= 0.0:
        return found  # `last` was the end of the map
    for n in range(model.landmarks):
        offset = marker_position(model, state, world, n) - p
        distance = wp.float32(wp.sqrt(offset[0] * offset[0] + offset[1] * offset[1]))
        behind = distance > last.distance or (distance == last.distance and n > last.index)
        nearer = found.index < 0 or distance < found.distance
        if state.present[world, n] != 0 and behind and nearer:  # an absent landmark is on no map
            found.index = n
            found.distance = distance
    return found


@device_function
def behind_vehicle(model: Any, state: Any, world: int, vehicle: int, origin: Any, line: Any, inverse_square: Any):
    """Return whether another vehicle, at the pose of its last message, occludes a line of sight."""
    now = state.tick[world]
    for sender in range(model.vehicles):
        agent = model.landmarks + sender
        half = model.scene.body_half[agent]
        if sender != vehicle and half[0] > half.dtype(0.0) and fresh(model, state, world, vehicle, sender, now):
            R = state.inbox_rotation[world, vehicle, sender]
            center = state.inbox_position[world, vehicle, sender] + R * model.scene.body_center[agent]
            if segment_hits_box(origin, line, inverse_square, R, center, half):
                return True
    return False


@device_function
def expected_in_view(model: Any, state: Any, world: int, vehicle: int, point: Any) -> bool:
    """Return whether a point of the map, m, is visible from a vehicle's estimated pose.

    It is in range, in the image, and occluded by no building and no vehicle at the pose of its last message.
    """
    if model.sensed == 0:
        return True
    R = state.estimate_rotation[world, vehicle]
    camera = model.camera[vehicle]
    origin = R * (state.estimate_position[world, vehicle] + camera.position)
    line = point - origin
    if wp.dot(line, line) > camera.range * camera.range:
        return False
    if camera.pinhole == 1:
        _, _, inside = project(camera, wp.transpose(R * camera_to_body(model, state, world, vehicle)) * line)
        if inside == 0:
            return False
    inverse_square = inverse_square_of(line)
    if behind_building(model, origin, line, inverse_square):
        return False
    return not behind_vehicle(model, state, world, vehicle, origin, line, inverse_square)


@wp.func
def closest_on_segment(position: wp.vec2, velocity: wp.vec2, duration: wp.float32) -> wp.float32:
    """Return the closest approach (m) of two points within a duration (s), from their relative motion."""
    time = wp.clamp(-wp.dot(position, velocity) / wp.max(wp.length_sq(velocity), 1.0e-9), 0.0, duration)
    return wp.length(position + time * velocity)


@wp.func
def closest_approach_driving(ahead: wp.vec4, step: wp.float32, speed: wp.float32, position: wp.vec2, forward: wp.vec2):
    """Return the closest approach (m) to a neighbour that drives straight on while the vehicle follows its route.

    Args:
        ahead: directions of the route 1, 2, 4 and 8 steps ahead, rad to the left.
        step: m.
        speed: of both, m/s, above 0.
        position: of the neighbour, m, body frame.
        forward: heading of the neighbour, unit vector, body frame.
    """
    closest, begin, at = FAR, 0.0, wp.vec2()
    for k in range(4):
        if begin < FORESIGHT:
            to = step * wp.vec2(wp.cos(ahead[k]), wp.sin(ahead[k]))
            time = step / speed - begin
            velocity = (to - at) / time
            duration = wp.where(k == 3, FORESIGHT, wp.min(step / speed, FORESIGHT)) - begin
            apart = position + begin * speed * forward - at
            closest = wp.min(closest, closest_on_segment(apart, speed * forward - velocity, duration))
            begin += time
            at = to
            step += step
    return closest


@wp.func
def closest_approach_standing(speed: wp.float32, position: wp.vec2, forward: wp.vec2):
    """Return the closest approach (m) to a neighbour that drives straight on while the vehicle stands.

    Arguments as of `closest_approach_driving`.
    """
    return wp.min(FAR, closest_on_segment(position, speed * forward, FORESIGHT))
