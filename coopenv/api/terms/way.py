"""The way that a vehicle has to make, as it believes to be along it: what the terms per metre count."""

from typing import Any

import warp as wp

from coopenv.world.collision import ARRIVED

FASTEST = wp.constant(wp.float64(2.0))
"""A vehicle's way grows at most by so many times its top speed (a bend's inside is shorter): a jump is no driving."""


@wp.func
def way_made(model: Any, state: Any, world: int, vehicle: int):
    """Return (how far along its way the vehicle believes to be, how long that is), m; (0, 0) without a goal."""
    agent = model.landmarks + vehicle
    p = state.estimate_rotation[world, vehicle] * state.estimate_position[world, vehicle]
    zero = p.dtype(0.0)
    if model.scene.goal_radius[vehicle] <= zero:
        return zero, zero
    start = model.start.position[agent]
    line = model.scene.goal[vehicle] - start
    length = wp.sqrt(line[0] * line[0] + line[1] * line[1])
    along = (p[0] - start[0]) * line[0] + (p[1] - start[1]) * line[1]
    return wp.clamp(along / wp.max(length, p.dtype(1.0e-6)), zero, length), length


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
