"""The way that a vehicle has to make, as it believes to be along it: what the terms per metre count."""

from typing import Any

import warp as wp

from coopenv.world.collision import ARRIVED
from coopenv.world.route import place_on_route, route_length

FASTEST = wp.constant(wp.float64(2.0))
"""A vehicle's way grows at most by so many times its top speed (a bend's inside is shorter): a jump is no driving."""


@wp.func
def way_made(model: Any, state: Any, world: int, vehicle: int):
    """Return (how far along its way the vehicle believes to be, how long that is), m; (0, 0) without a goal."""
    p = state.estimate_rotation[world, vehicle] * state.estimate_position[world, vehicle]
    s, _, _ = place_on_route(state, world, vehicle, p[0], p[1])
    length = route_length(state, world, vehicle)
    return wp.clamp(s, p.dtype(0.0), length), length


@wp.func
def metres(model: Any, state: Any, results: Any, world: int, vehicle: int, elapsed: wp.float64):
    """Return the metres of its way that a vehicle gains in this decision, and those that it will never drive.

    The second are 0 but in the step that ends its episode, and then if it has arrived.
    """
    way, length = way_made(model, state, world, vehicle)
    zero = type(way)(0.0)
    last = results.furthest[world, vehicle]
    most = model.dynamics.max_speed * type(way)(FASTEST * elapsed)
    gained = wp.clamp(way - last, zero, most)
    missed = zero
    ends = results.terminated[world, vehicle] or results.truncated[world, vehicle]
    if ends and results.alive[world, vehicle] and state.ended[world, vehicle] != ARRIVED:
        missed = wp.max(length - last - gained, zero)
    return gained, missed
