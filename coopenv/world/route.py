"""Routes of vehicles, and the traffic of simulated worlds, which follows them.

A route is a line of points (x, y, s) in the map frame, s the arc length from its first point, m. Beyond its ends it
goes on straight: s is negative before the first point and above the length behind the last. At a reset a route is drawn
from the vehicle's routes, shifted sideways and bent, or leads straight to the goal.

Traffic also follows the vehicle ahead and signals, and appears at its time. The longitudinal model is the intelligent
driver model (Treiber, Hennecke and Helbing, Congested traffic states in empirical observations and microscopic
simulations, Physical Review E 62, 2000); its parameters are from city traffic in Treiber and Kesting, Traffic Flow
Dynamics, 2013, table 11.2. The steering is pure pursuit (Coulter, 1992).
"""

from typing import Any

import warp as wp

from coopenv.estimation import Outcome
from coopenv.estimation.linalg import exp_so3
from coopenv.world.nearby import body_of, cell_at, first_in, has_body, last_of_all, next_in, window_about
from coopenv.world.random import NEXT_ROUTE, ROUTE, ROUTE_SHAPE, WANDER, on_cells, random_words, signed_uniform, uniform
from coopenv.world.warp_internals import device_function, outlined

UNDER_WAY = wp.constant(int(Outcome.UNDER_WAY))


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
"""First number of the draws of later routes' shapes; draws at a reset are numbered by its attempts."""


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
    """Return whether a route may follow a vehicle's route."""
    old = state.route_drawn[world, vehicle]
    row = model.drawn.next_row[vehicle]
    return old >= 0 and model.drawn.next_first[row, old + 1] > model.drawn.next_first[row, old]


@wp.func
def draw_next_route(model: Any, state: Any, world: int, vehicle: int):
    """Draw the next route of an arrived vehicle, from the routes that start at the end of the old one."""
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
            count = int(0)  # the vehicle is present
    state.goal[world, vehicle] = goal
    state.route_count[world, vehicle] = count
    state.route_drawn[world, vehicle] = -1


TIME_GAP, STANDSTILL_GAP = wp.constant(1.0), wp.constant(2.0)  # s; m, between bumpers
ACCELERATION, DECELERATION = wp.constant(1.0), wp.constant(1.5)  # m/s^2, largest and comfortable
LATERAL = wp.constant(2.0)  # m/s^2, in bends
MARGIN = wp.constant(0.3)  # m beside a body, within which another one is in its way
FORESIGHT = wp.constant(3.0)  # s for which a vehicle looks ahead, and besides
NEAR = wp.constant(15.0)  # m; and the distance of other bodies from which on a vehicle appears


@wp.func
def following_acceleration(speed: Any, wanted: Any, gap: Any, ahead: Any):
    """Return the acceleration (m/s^2) of the intelligent driver model.

    `gap`, m, is that to the vehicle ahead, which drives at `ahead`, m/s; `wanted` is the speed on a free road.
    """
    one = type(speed)(1.0)
    root = type(speed)(2.0) * wp.sqrt(type(speed)(ACCELERATION) * type(speed)(DECELERATION))
    closing = wp.max(speed * type(speed)(TIME_GAP) + speed * (speed - ahead) / root, one - one)
    share = (type(speed)(STANDSTILL_GAP) + closing) / wp.max(gap, type(speed)(0.1))
    free = speed / wanted
    return type(speed)(ACCELERATION) * (one - free * free * free * free - share * share)


@outlined
def bend_speed(state: Any, world: int, vehicle: int, s: Any, top: Any):
    """Return the speed (m/s) from which a vehicle at arc length `s` can slow down for the bends of its route."""
    step = type(s)(3.0)
    square = top * top
    _, _, heading = point_on_route(state, world, vehicle, s)
    for k in range(8):
        x = step * type(s)(k)
        _, _, later = point_on_route(state, world, vehicle, s + x + step)
        turn = wp.abs(wp.atan2(wp.sin(later - heading), wp.cos(later - heading)))
        heading = later
        bend = type(s)(LATERAL) * step / wp.max(turn, type(s)(1.0e-6))
        square = wp.min(square, bend + type(s)(2.0) * type(s)(DECELERATION) * x)
    return wp.sqrt(square)


@outlined
def gap_ahead(model: Any, state: Any, world: int, vehicle: int, s: Any, front: Any):
    """Return the gap (m) to the nearest body in a vehicle's way, and its speed along the route (m/s).

    `s` is the arc length of the vehicle's reference point on its route, its front is `front` ahead, m.
    """
    agent = model.landmarks + vehicle
    here = state.position[world, agent]
    half = model.scene.body_half[agent]
    forward = state.rotation[world, agent] * type(here)(half.dtype(1.0), half.dtype(0.0), half.dtype(0.0))
    gap = type(s)(1.0e6)
    speed = type(s)(0.0)
    reach = type(s)(NEAR) + type(s)(FORESIGHT) * state.speed[world, vehicle]
    last = last_of_all(model)
    x, y, columns, rows = window_about(model, here, here, reach)
    for row in range(rows):
        for column in range(columns):
            item = first_in(model, state, world, cell_at(model, x + column, y + row))
            while item >= 0:
                if item != agent and has_body(model, state, world, item):
                    R, center, other = body_of(model, state, world, item)
                    offset = center - here
                    if wp.dot(offset, forward) > -half[0] and wp.length(offset) < reach:
                        there, aside, heading = place_on_route(state, world, vehicle, center[0], center[1])
                        c = wp.cos(heading) * R[0, 0] + wp.sin(heading) * R[1, 0]
                        d = wp.cos(heading) * R[1, 0] - wp.sin(heading) * R[0, 0]
                        along = wp.abs(c) * other[0] + wp.abs(d) * other[1]
                        across = wp.abs(d) * other[0] + wp.abs(c) * other[1]
                        free = there - along - s - front
                        if wp.abs(aside) < half[1] + across + type(s)(MARGIN) and there > s + front and free < gap:
                            gap = free
                            speed = type(s)(0.0)
                            if item < model.agents:
                                speed = wp.max(c * state.velocity[world, item][0], type(s)(0.0))
                item = next_in(model, state, world, item, last)
    return gap, speed


@device_function
def gap_to_signal(model: Any, state: Any, world: int, vehicle: int, s: Any, tick: int):
    """Return the gap (m) that lets a vehicle whose front is at arc length `s` stop at a red signal; 1e6: it goes on.

    A vehicle that cannot stop any more goes on. A front just beyond the line stops as well.
    """
    route = state.route_drawn[world, vehicle]
    gap = model.routes.signal_at[route] - s + type(s)(STANDSTILL_GAP)
    speed = state.speed[world, vehicle]
    stops = speed * speed < type(s)(2.0) * model.dynamics[vehicle].max_acceleration * gap
    period = wp.float64(model.routes.signal_period[route])
    time = wp.float64(tick) * model.camera_period - wp.float64(model.routes.signal_start[route])
    phase = time - period * wp.floor(time / period)
    if gap > type(s)(0.0) and stops and phase >= wp.float64(model.routes.signal_green[route]):
        return gap
    return type(s)(1.0e6)


@outlined
def direct_traffic(model: Any, state: Any, world: int, vehicle: int, tick: int):
    """Write the command that a vehicle of the traffic follows until the next tick, from the poses of this one."""
    limits = model.dynamics[vehicle]
    if limits.in_traffic == 0:
        return
    agent = model.landmarks + vehicle
    here = state.position[world, agent]
    R = state.rotation[world, agent]
    speed = state.speed[world, vehicle]
    front = model.scene.body_center[agent][0] + model.scene.body_half[agent][0]
    s, _, _ = place_on_route(state, world, vehicle, here[0], here[1])
    x, y, _ = point_on_route(state, world, vehicle, s + limits.wheelbase + speed * type(speed)(0.5))
    to = wp.transpose(R) * type(here)(x - here[0], y - here[1], here[2] - here[2])
    steering = wp.atan(type(speed)(2.0) * limits.wheelbase * to[1] / wp.dot(to, to))
    gap, ahead = gap_ahead(model, state, world, vehicle, s, front)
    wanted = bend_speed(state, world, vehicle, s, limits.max_speed)
    signal = gap_to_signal(model, state, world, vehicle, s + front, tick)
    acceleration = following_acceleration(speed, wanted, gap, ahead)
    acceleration = wp.min(acceleration, following_acceleration(speed, wanted, signal, speed - speed))
    rate = wp.min(wp.abs(acceleration), limits.max_acceleration)
    target = wp.where(acceleration > speed - speed, limits.max_speed, speed - speed)
    state.command[world, vehicle] = wp.vector(target, steering, rate, speed - speed, speed - speed)


@device_function
def is_room(model: Any, state: Any, world: int, vehicle: int) -> bool:
    """Return whether no other vehicle is near a vehicle that is to appear."""
    here = state.position[world, model.landmarks + vehicle]
    for other in range(model.landmarks, model.agents):
        if state.present[world, other] == 1 and wp.length(state.position[world, other] - here) < here.dtype(NEAR):
            return False
    return True


@device_function
def appear(model: Any, state: Any, world: int, tick: int):
    """Let due vehicles appear if no vehicle is near their start; the others have moved already."""
    for vehicle in range(model.vehicles):
        agent = model.landmarks + vehicle
        if state.present[world, agent] == 0 and state.ended[world, vehicle] == UNDER_WAY:
            if tick >= state.entry_tick[world, vehicle] and is_room(model, state, world, vehicle):
                state.present[world, agent] = 1
