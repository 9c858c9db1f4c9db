"""The way that a vehicle has to make, its route, as it believes to be along it: observations and terms per metre."""

from typing import Any

import warp as wp

from coopenv.world.collision import ARRIVED
from coopenv.world.device_function import device_function
from coopenv.world.route import place_on_route, point_on_route, route_length

FASTEST = wp.constant(wp.float64(2.0))
"""A vehicle's way grows at most by so many times its top speed (a bend's inside is shorter): a jump is no driving."""


@device_function
def way_made(model: Any, state: Any, world: int, vehicle: int):
    """Return (how far along its way the vehicle believes to be, how long that is), m; (0, 0) without a goal."""
    p = state.estimate_rotation[world, vehicle] * state.estimate_position[world, vehicle]
    s, _, _ = place_on_route(state, world, vehicle, p[0], p[1])
    length = route_length(state, world, vehicle)
    return wp.clamp(s, p.dtype(0.0), length), length


@wp.func
def turn_between(first: Any, second: Any):
    """Return the angle from the second to the first direction, rad in [-pi, pi]."""
    return wp.atan2(wp.sin(first - second), wp.cos(first - second))


@device_function
def seen_from_estimate(model: Any, state: Any, world: int, vehicle: int):
    """Return a vehicle's way as it believes to see it; 0 without a goal.

    Returns:
        Its offset to the left of it (m), its heading less that of the way (rad), what is left (m), and where the way
        goes on 1, 2, 4 and 8 steps ahead: directions in rad, from the body's x axis to the left.
    """
    R = state.estimate_rotation[world, vehicle]
    p = R * state.estimate_position[world, vehicle]
    length = route_length(state, world, vehicle)
    zero = length - length
    ahead = wp.vec4()
    if length <= zero:
        return zero, zero, zero, ahead
    s, offset, along = place_on_route(state, world, vehicle, p[0], p[1])
    heading = wp.atan2(R[1, 0], R[0, 0])
    step = model.route_step
    for k in range(4):
        x, y, _ = point_on_route(state, world, vehicle, s + step)
        ahead[k] = wp.float32(turn_between(wp.atan2(y - p[1], x - p[0]), heading))
        step = step + step
    return offset, turn_between(heading, along), wp.max(length - s, zero), ahead


@device_function
def furthest_so_far(state: Any, results: Any, world: int, vehicle: int):
    """Return the farthest along its present way that a vehicle had believed to be, m: 0 on a route that is new."""
    last = results.furthest[world, vehicle]
    if (
        state.arrivals[world, vehicle] != results.last_arrivals[world, vehicle]
        and state.ended[world, vehicle] != ARRIVED
    ):
        last = last - last
    return last


@device_function
def metres(model: Any, state: Any, results: Any, world: int, vehicle: int, elapsed: wp.float64):
    """Return the metres of its way that a vehicle gains in this decision, and those that it will never drive.

    The second are 0 but in the step that ends its episode, and then if it has arrived.
    """
    way, length = way_made(model, state, world, vehicle)
    zero = way - way
    last = furthest_so_far(state, results, world, vehicle)
    most = model.dynamics[vehicle].max_speed * type(way)(FASTEST * elapsed)
    gained = wp.clamp(way - last, zero, most)
    missed = zero
    ends = results.terminated[world, vehicle] or results.truncated[world, vehicle]
    if ends and results.alive[world, vehicle] and state.ended[world, vehicle] != ARRIVED:
        missed = wp.max(length - last - gained, zero)
    return gained, missed
