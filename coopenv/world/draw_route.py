"""Draw the route of a vehicle at a reset: one of its own, shifted sideways and wandering, or straight to its goal."""

from typing import Any

import warp as wp

from coopenv.estimation.so3 import exp_so3
from coopenv.world.parameters import WANDER
from coopenv.world.random import NEXT_ROUTE, ROUTE, ROUTE_SHAPE, on_cells, random_words, signed_uniform, uniform
from coopenv.world.route import has_routes, point_on_route

TURN = wp.constant(6.283185307179586)

AFTER_STARTS = wp.constant(1000)
"""Draws of the shapes of later routes are numbered from here on, those at a reset by its attempts."""


@wp.func
def add_point(state: Any, world: int, vehicle: int, k: int, x: Any, y: Any):
    """Write point k of a route behind the points before it."""
    s = x - x
    if k > 0:
        before = state.route[world, vehicle, k - 1]
        s = before[2] + wp.sqrt((x - before[0]) * (x - before[0]) + (y - before[1]) * (y - before[1]))
    state.route[world, vehicle, k] = type(state.goal[world, vehicle])(x, y, s)


@wp.func
def wave(share: Any, first: Any, second: Any):
    """Return the sideways deviation of a wandering route in [-1, 1], at a share of its length.

    A wave of one period and one of two, with phases in turns; they vanish at both ends.
    """
    turn = type(share)(TURN)
    waves = wp.sin(turn * (share + first)) + wp.sin(turn * (type(share)(2.0) * share + second))
    return wp.sin(turn * share * type(share)(0.5)) * waves * type(share)(0.5)


@wp.func
def one_of(word: wp.uint32, first: int, count: int) -> int:
    """Return one of the numbers first .. first + count - 1, by a random word."""
    return first + wp.min(int(uniform(word, wp.float64(1.0)) * wp.float64(count)), count - 1)


@wp.func
def draw_route(model: Any, state: Any, world: int, vehicle: int, attempt: int):
    """Draw one of a vehicle's routes and its variant.

    Returns:
        Where along the route the vehicle starts, m.
    """
    first = model.routes.first[vehicle]
    words = random_words(state.seed[world], state.episode[world], attempt, vehicle, ROUTE)
    choice = one_of(words[3], first, model.routes.first[vehicle + 1] - first)
    return shape_route(model, state, world, vehicle, model.routes.choice[choice], attempt, words)


@wp.func
def draw_next_route(model: Any, state: Any, world: int, vehicle: int):
    """Draw the route of a vehicle that has arrived, among those that start where its old one ends."""
    old = state.route_drawn[world, vehicle]
    arrival = state.arrivals[world, vehicle]
    first = model.drawn.next_first[vehicle, old]
    words = random_words(state.seed[world], state.episode[world], arrival, vehicle, NEXT_ROUTE)
    choice = one_of(words[3], first, model.drawn.next_first[vehicle, old + 1] - first)
    shape_route(model, state, world, vehicle, model.drawn.next_choice[choice], AFTER_STARTS + arrival, words)


@wp.func
def shape_route(model: Any, state: Any, world: int, vehicle: int, route: int, index: int, drawn: Any):
    """Write a variant of a route of the scenario as the vehicle's, and return where it may start, m."""
    r = model.routes
    one = type(r.height)(1.0)
    zero = one - one
    seed = state.seed[world]
    words = on_cells(drawn, seed, r.lateral_spread[route] > zero, r.start_spread[route] > zero, False)
    shift = r.lateral_spread[route] * signed_uniform(words[0], one)
    start = r.start_spread[route] * uniform(words[1], one)
    wander = r.wander[route] * state.parameter[world, WANDER]
    phases = random_words(seed, state.episode[world], index, vehicle, ROUTE_SHAPE)
    count = r.count[route]
    for k in range(count):
        designed = r.point[route, k]
        share = type(one)(k) / type(one)(count - 1)
        aside = shift + wander * wave(share, uniform(phases[0], one), uniform(phases[1], one))
        x = designed[0] - aside * wp.sin(designed[2])
        y = designed[1] + aside * wp.cos(designed[2])
        add_point(state, world, vehicle, k, x, y)
    end = state.route[world, vehicle, count - 1]
    state.goal[world, vehicle] = type(end)(end[0], end[1], r.height)
    state.route_count[world, vehicle] = count
    state.route_drawn[world, vehicle] = route
    return start


@wp.func
def start_on_route(model: Any, state: Any, world: int, vehicle: int, s: Any):
    """Return the pose (position, R) of a vehicle that stands on its route at an arc length."""
    x, y, heading = point_on_route(state, world, vehicle, s)
    position = type(state.goal[world, vehicle])(x, y, model.routes.height)
    return position, exp_so3(type(position)(s - s, s - s, heading))


@wp.func
def go_straight(model: Any, state: Any, world: int, vehicle: int):
    """Make the route of a vehicle without routes: the straight line from its nominal start to its goal, if it has one.

    The nominal start is known beforehand; a line from the true one would tell a vehicle where it is.
    """
    if has_routes(model, vehicle):
        return
    goal = model.routes.goal[vehicle]
    start = model.start.position[model.landmarks + vehicle]
    count = int(0)
    if model.scene.goal_radius[vehicle] > goal.dtype(0.0):
        count = int(2)
        add_point(state, world, vehicle, 0, start[0], start[1])
        add_point(state, world, vehicle, 1, goal[0], goal[1])
        if state.route[world, vehicle, 1][2] == goal.dtype(0.0):
            count = int(0)  # it is there
    state.goal[world, vehicle] = goal
    state.route_count[world, vehicle] = count
    state.route_drawn[world, vehicle] = -1
