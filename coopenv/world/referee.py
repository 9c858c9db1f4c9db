"""Collision, arrival and departure: contacts of bodies, and the end of a vehicle's episode.

Contacts are boxes that touch (separating axes in the plane, and heights); an arrival is a goal within its radius.
"""

from typing import Any

import warp as wp

from coopenv.estimation import Outcome
from coopenv.world.nearby import body_of, cell_at, first_in, has_body, last_of_all, next_in, window_about
from coopenv.world.route import (
    UNDER_WAY,
    draw_next_route,
    goal_distance,
    has_next_route,
    has_routes,
    is_past_end,
    place_on_route,
    route_length,
)
from coopenv.world.warp_internals import device_function, outlined

ARRIVED = wp.constant(int(Outcome.ARRIVED))
COLLIDED = wp.constant(int(Outcome.COLLIDED))
OFF_ROUTE = wp.constant(int(Outcome.OFF_ROUTE))


@wp.func
def separated_along(axis: Any, offset: Any, Ra: Any, ha: Any, Rb: Any, hb: Any) -> bool:
    """Return whether a horizontal axis separates the footprints of two boxes."""
    reach_a = ha[0] * wp.abs(axis[0] * Ra[0, 0] + axis[1] * Ra[1, 0])
    reach_a += ha[1] * wp.abs(axis[0] * Ra[0, 1] + axis[1] * Ra[1, 1])
    reach_b = hb[0] * wp.abs(axis[0] * Rb[0, 0] + axis[1] * Rb[1, 0])
    reach_b += hb[1] * wp.abs(axis[0] * Rb[0, 1] + axis[1] * Rb[1, 1])
    return wp.abs(axis[0] * offset[0] + axis[1] * offset[1]) > reach_a + reach_b


@wp.func
def boxes_touch(ca: Any, Ra: Any, ha: Any, cb: Any, Rb: Any, hb: Any) -> bool:
    """Return whether two upright boxes overlap; false where a pose is not known (NaN)."""
    offset = cb - ca
    reach = wp.length(ha) + wp.length(hb)
    if not (wp.abs(offset[2]) <= ha[2] + hb[2] and wp.dot(offset, offset) <= reach * reach):
        return False
    for k in range(2):
        if separated_along(type(ca)(Ra[0, k], Ra[1, k], ha.dtype(0.0)), offset, Ra, ha, Rb, hb):
            return False
        if separated_along(type(ca)(Rb[0, k], Rb[1, k], ha.dtype(0.0)), offset, Ra, ha, Rb, hb):
            return False
    return True


@device_function
def touches_building_of(model: Any, cell: int, center: Any, R: Any, half: Any) -> bool:
    """Return whether a box overlaps one of the buildings of a cell."""
    for entry in range(model.cells.first_building[cell], model.cells.first_building[cell + 1]):
        k = model.cells.building[entry]
        building_R = model.scene.obstacle_rotation[k]
        if boxes_touch(center, R, half, model.scene.obstacle_center[k], building_R, model.scene.obstacle_half[k]):
            return True
    return False


@outlined
def touches_anything(model: Any, state: Any, world: int, vehicle: int) -> int:
    """Return 1 when a vehicle's box overlaps a building or another body."""
    return touches_one_of(model, state, world, vehicle, model.agents)


@device_function
def touches_one_of(model: Any, state: Any, world: int, vehicle: int, count: int) -> int:
    """Return 1 when a vehicle's box overlaps a building, another of the first `count` agents or, with all, traffic."""
    agent = model.landmarks + vehicle
    half = model.scene.body_half[agent]
    if half[0] <= half.dtype(0.0) or state.present[world, agent] == 0:
        return 0
    R = state.rotation[world, agent]
    center = state.position[world, agent] + R * model.scene.body_center[agent]
    own = wp.length(half)
    last = last_of_all(model)
    x, y, columns, rows = window_about(model, center, center, own + state.body_reach[world])
    for row in range(rows):
        for column in range(columns):
            cell = cell_at(model, x + column, y + row)
            if touches_building_of(model, cell, center, R, half):
                return 1
            item = first_in(model, state, world, cell)
            while item >= 0:
                counts = item < count or count == model.agents
                if counts and item != agent and has_body(model, state, world, item):
                    other_R, other_center, other_half = body_of(model, state, world, item)
                    if boxes_touch(center, R, half, other_center, other_R, other_half):
                        return 1
                item = next_in(model, state, world, item, last)
    return 0


@device_function
def reaches_goal(model: Any, state: Any, world: int, vehicle: int) -> bool:
    """Return whether a vehicle has a goal and is within its radius, or past the end of the route that it drew."""
    radius = model.scene.goal_radius[vehicle]
    if radius <= radius.dtype(0.0):
        return False
    if goal_distance(model, state, world, vehicle) < radius:
        return True
    return has_routes(model, vehicle) and is_past_end(model, state, world, vehicle, radius)


@device_function
def has_left_route(model: Any, state: Any, world: int, vehicle: int) -> bool:
    """Return whether a vehicle is farther beside its route, or beyond an end of it, than is allowed.

    The check runs at the end of a decision.
    """
    allowed = model.scene.off_route
    if allowed <= allowed.dtype(0.0) or (state.tick[world] + 1) % model.ticks_per_decision != 0:
        return False
    p = state.position[world, model.landmarks + vehicle]
    s, offset, _ = place_on_route(state, world, vehicle, p[0], p[1])
    beyond = wp.max(s - route_length(state, world, vehicle), -s)
    return wp.max(wp.abs(offset), beyond) > allowed


@device_function
def depart(model: Any, state: Any, world: int, vehicle: int):
    """Take a vehicle that has arrived off the scene, where vehicles leave; called at the start of a tick."""
    if model.drawn.leaves == 1 and state.ended[world, vehicle] == ARRIVED:
        state.present[world, model.landmarks + vehicle] = 0


@outlined
def referee(model: Any, state: Any, world: int, vehicle: int):
    """Mark contact, and end the vehicle's episode on a collision or an arrival that counts; or give it a new route."""
    touching = touches_anything(model, state, world, vehicle)
    ended = state.ended[world, vehicle]
    if ended == UNDER_WAY:
        if touching == 1 and model.scene.end_on_collision == 1:
            ended = COLLIDED
        elif model.scene.end_on_arrival == 1:
            if reaches_goal(model, state, world, vehicle):
                state.arrivals[world, vehicle] += 1
                if has_next_route(model, state, world, vehicle):
                    draw_next_route(model, state, world, vehicle)
                else:
                    ended = ARRIVED
        if ended == UNDER_WAY and has_left_route(model, state, world, vehicle):
            ended = OFF_ROUTE
    state.collided[world, vehicle] = touching
    state.ended[world, vehicle] = ended
