"""The route of a vehicle: a line of points (x, y, s) in the map frame, s the arc length from its first point, m.

Beyond its ends a route goes on straight: s is negative before the first point and above the length behind the last.
At a reset a route is drawn among those of the vehicle, shifted sideways and bent, or leads straight to the goal.
"""

from typing import Any

import warp as wp

from coopenv.estimation.linalg import exp_so3
from coopenv.world.random import NEXT_ROUTE, ROUTE, ROUTE_SHAPE, WANDER, on_cells, random_words, signed_uniform, uniform
from coopenv.world.warp_internals import device_function


@device_function
def has_routes(model: Any, vehicle: int) -> bool:
    """Return whether a vehicle's route is drawn among the scenario's (otherwise it leads straight to its goal)."""
    return model.routes.first[vehicle + 1] > model.routes.first[vehicle]


@device_function
def route_length(state: Any, world: int, vehicle: int):
    """Return the length of a vehicle's route, m; 0 without one."""
    length = type(state.speed[world, vehicle])(0.0)
    if state.route_count[world, vehicle] > 0:
        length = state.route[world, vehicle, state.route_count[world, vehicle] - 1][2]
    return length


@device_function
def route_tangent(state: Any, world: int, vehicle: int, segment: int, share: Any):
    """Return the horizontal direction of a route, of length 1, at a fraction in [0, 1] of a segment.

    At a point it is parallel to the chord of its neighbours, along a segment it turns evenly.
    """
    last = state.route_count[world, vehicle] - 1
    before = state.route[world, vehicle, wp.max(segment - 1, 0)]
    begin = state.route[world, vehicle, segment]
    end = state.route[world, vehicle, segment + 1]
    after = state.route[world, vehicle, wp.min(segment + 2, last)]
    zero = share - share
    first = wp.normalize(type(begin)(end[0] - before[0], end[1] - before[1], zero))
    second = wp.normalize(type(begin)(after[0] - begin[0], after[1] - begin[1], zero))
    return wp.normalize(first + (second - first) * share)


@device_function
def place_on_route(state: Any, world: int, vehicle: int, x: Any, y: Any):
    """Return (arc length, lateral offset, heading) at the point of a vehicle's route nearest to a point of the map.

    Arguments and results in m and rad; the offset of the point is positive to the left of the route. All are 0
    without a route.
    """
    count = state.route_count[world, vehicle]
    zero = x - x
    if count < 2:
        return zero, zero, zero
    one = zero + type(zero)(1.0)
    nearest = one * type(zero)(1.0e18)
    segment = int(0)
    share = zero
    for k in range(count - 1):
        a = state.route[world, vehicle, k]
        b = state.route[world, vehicle, k + 1]
        dx = b[0] - a[0]
        dy = b[1] - a[1]
        along = ((x - a[0]) * dx + (y - a[1]) * dy) / (dx * dx + dy * dy)
        inside = wp.clamp(along, zero, one)
        ex = x - a[0] - inside * dx
        ey = y - a[1] - inside * dy
        distance = ex * ex + ey * ey
        if distance < nearest:
            nearest = distance
            segment = k
            share = along
    a = state.route[world, vehicle, segment]
    b = state.route[world, vehicle, segment + 1]
    if segment > 0:
        share = wp.max(share, zero)
    if segment < count - 2:
        share = wp.min(share, one)
    inside = wp.clamp(share, zero, one)
    tangent = route_tangent(state, world, vehicle, segment, inside)
    ex = x - a[0] - share * (b[0] - a[0])
    ey = y - a[1] - share * (b[1] - a[1])
    side = tangent[0] * ey - tangent[1] * ex
    lateral = wp.sqrt(ex * ex + ey * ey) * wp.where(side < zero, -one, one)
    return a[2] + share * (b[2] - a[2]), lateral, wp.atan2(tangent[1], tangent[0])


@device_function
def point_on_route(state: Any, world: int, vehicle: int, s: Any):
    """Return (x, y, heading) of a vehicle's route at an arc length, m and rad; 0 without a route."""
    count = state.route_count[world, vehicle]
    zero = s - s
    if count < 2:
        return zero, zero, zero
    segment = int(0)
    beyond = count - 1
    while segment + 1 < beyond:
        middle = (segment + beyond) // 2
        if state.route[world, vehicle, middle][2] <= s:
            segment = middle
        else:
            beyond = middle
    a = state.route[world, vehicle, segment]
    b = state.route[world, vehicle, segment + 1]
    share = (s - a[2]) / (b[2] - a[2])
    tangent = route_tangent(state, world, vehicle, segment, wp.clamp(share, zero, zero + type(zero)(1.0)))
    return a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1]), wp.atan2(tangent[1], tangent[0])


@device_function
def goal_distance(model: Any, state: Any, world: int, vehicle: int):
    """Return the horizontal distance to the vehicle's goal, m."""
    to_goal = state.goal[world, vehicle] - state.position[world, model.landmarks + vehicle]
    return wp.sqrt(to_goal[0] * to_goal[0] + to_goal[1] * to_goal[1])


@device_function
def remaining_way(model: Any, state: Any, world: int, vehicle: int):
    """Return the distance to the goal, m: along the drawn route, or straight without a route."""
    if has_routes(model, vehicle):
        p = state.position[world, model.landmarks + vehicle]
        s, _, _ = place_on_route(state, world, vehicle, p[0], p[1])
        return wp.max(route_length(state, world, vehicle) - s, p.dtype(0.0))
    return goal_distance(model, state, world, vehicle)


@device_function
def is_past_end(model: Any, state: Any, world: int, vehicle: int, radius: Any) -> bool:
    """Return whether a vehicle has left its drawn route behind, no farther than `radius` beside its prolongation."""
    count = state.route_count[world, vehicle]
    if count < 2:
        return False
    p = state.position[world, model.landmarks + vehicle]
    end = state.route[world, vehicle, count - 1]
    before = state.route[world, vehicle, count - 2]
    # Nearly always a look at the last segment is enough.
    if (p[0] - end[0]) * (end[0] - before[0]) + (p[1] - end[1]) * (end[1] - before[1]) < p.dtype(0.0):
        return False
    s, lateral, _ = place_on_route(state, world, vehicle, p[0], p[1])
    return s >= end[2] and wp.abs(lateral) < radius


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
    """Return a random number of first .. first + count - 1."""
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
def has_next_route(model: Any, state: Any, world: int, vehicle: int) -> bool:
    """Return whether a route may follow that of a vehicle."""
    old = state.route_drawn[world, vehicle]
    row = model.drawn.next_row[vehicle]
    return old >= 0 and model.drawn.next_first[row, old + 1] > model.drawn.next_first[row, old]


@wp.func
def draw_next_route(model: Any, state: Any, world: int, vehicle: int):
    """Draw the route of a vehicle that has arrived, among those that start where its old one ends."""
    old = state.route_drawn[world, vehicle]
    arrival = state.arrivals[world, vehicle]
    row = model.drawn.next_row[vehicle]
    first = model.drawn.next_first[row, old]
    words = random_words(state.seed[world], state.episode[world], arrival, vehicle, NEXT_ROUTE)
    choice = one_of(words[3], first, model.drawn.next_first[row, old + 1] - first)
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

    The line starts at the nominal start, which is known; the true start would reveal the vehicle's position.
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
