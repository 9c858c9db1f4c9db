"""Traffic of simulated worlds: vehicles follow their routes, the vehicle ahead and signals, and appear at their time.

The longitudinal model is the intelligent driver model (Treiber, Hennecke and Helbing, Congested traffic states in
empirical observations and microscopic simulations, Physical Review E 62, 2000); its numbers are those of city traffic
in Treiber and Kesting, Traffic Flow Dynamics, 2013, table 11.2. The steering is pure pursuit (Coulter, 1992).
"""

from typing import Any

import warp as wp

from coopenv.world.cells import body_of, cell_at, first_in, has_body, last_of_all, next_in, window_about
from coopenv.world.dynamics import UNDER_WAY
from coopenv.world.route import place_on_route, point_on_route
from coopenv.world.warp_internals import device_function

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


@device_function
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


@device_function
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
            item = first_in(state, world, cell_at(model, x + column, y + row), last)
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
                item = next_in(state, world, item, last)
    return gap, speed


@device_function
def gap_to_signal(model: Any, state: Any, world: int, vehicle: int, s: Any, tick: int):
    """Return the gap (m) that lets a vehicle whose front is at arc length `s` stop at a red signal; 1e6: it goes on.

    It goes on where it cannot stop any more. A front just beyond the line stops as well.
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


@device_function
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
    state.command[world, vehicle] = wp.vector(target, steering, rate, speed - speed)


@device_function
def is_room(model: Any, state: Any, world: int, vehicle: int) -> bool:
    """Return whether no other vehicle is near one that is to appear."""
    here = state.position[world, model.landmarks + vehicle]
    for other in range(model.landmarks, model.agents):
        if state.present[world, other] == 1 and wp.length(state.position[world, other] - here) < here.dtype(NEAR):
            return False
    return True


@device_function
def appear(model: Any, state: Any, world: int, tick: int):
    """Let vehicles appear whose time has come and near whose start there is none; the others have moved already."""
    for vehicle in range(model.vehicles):
        agent = model.landmarks + vehicle
        if state.present[world, agent] == 0 and state.ended[world, vehicle] == UNDER_WAY:
            if tick >= state.entry_tick[world, vehicle] and is_room(model, state, world, vehicle):
                state.present[world, agent] = 1
