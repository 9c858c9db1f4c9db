"""The truth moves, by prescribed motion as a closed form, or as a kinematic bicycle with its actuators."""

from typing import Any

import warp as wp

from coopenv.estimation.so3 import increment, orthonormalise, rigid_motion
from coopenv.world.command import ACCELERATION, PAN, SPEED, STEERING, command_in_force
from coopenv.world.model import DRIVEN, PRESCRIBED

LONGEST_SUBSTEP = wp.constant(wp.float64(0.0100001))  # s; the bicycle's twist is held over no longer than this


@wp.func
def segment_at(model: Any, agent: int, t: wp.float64) -> int:
    """Return the index of the segment of an agent's prescribed motion that holds at time t."""
    low = model.motion.first[agent]
    high = model.motion.first[agent + 1] - 1
    while low < high:
        middle = (low + high + 1) // 2
        if model.motion.start[middle] <= t:
            low = middle
        else:
            high = middle - 1
    return low


@wp.func
def prescribe(model: Any, state: Any, world: int, agent: int, t: wp.float64):
    """Set an agent's pose and twist to its prescribed motion at time t, at the pace that has been drawn."""
    pace = state.pace[world, agent]
    at = t * wp.float64(pace)
    segment = segment_at(model, agent, at)
    v = model.motion.linear[segment]
    w = model.motion.angular[segment]
    h = v.dtype(at - model.motion.start[segment])
    R0 = state.start_rotation[world, agent]
    R = R0 * model.motion.rotation[segment]
    travelled = v * h
    turned = R
    if wp.dot(w, w) > v.dtype(0.0):
        turn, travelled = rigid_motion(w * h, travelled)
        turned = R * turn
    state.rotation[world, agent] = turned
    state.position[world, agent] = (
        state.start_position[world, agent] + R0 * model.motion.position[segment] + R * travelled
    )
    state.velocity[world, agent] = v * pace
    state.angular_velocity[world, agent] = w * pace


@wp.func
def first_order_lag(value: Any, target: Any, dt: Any, lag: Any, rate: Any):
    """Return the value after a first-order lag towards a target, its rate limited."""
    change = target - value
    if lag > type(lag)(0.0):
        change = change * (type(lag)(1.0) - wp.exp(-dt / lag))
    return value + wp.clamp(change, -rate * dt, rate * dt)


@wp.func
def actuate(d: Any, speed: Any, steering: Any, command: Any, dt: Any):
    """Return (speed, steering) after dt under a command and limits `d`, see `coopenv.world.command`."""
    wanted = command[SPEED]
    if wp.abs(wanted) < d.dead_band:
        wanted = type(wanted)(0.0)
    new_speed = first_order_lag(speed, wanted, dt, d.speed_lag, command[ACCELERATION])
    angle = wp.clamp(command[STEERING], -d.max_steering, d.max_steering)
    new_steering = first_order_lag(steering, angle, dt, d.steering_lag, d.max_steering_rate)
    return wp.clamp(new_speed, d.min_speed, d.max_speed), new_steering


@wp.func
def bicycle_step(d: Any, R: Any, position: Any, speed: Any, steering: Any, command: Any, dt: Any, parked: int):
    """Return (R, position, speed, steering) after dt: rear-axle bicycle, its twist held at the mid-point."""
    new_speed, new_steering = actuate(d, speed, steering, command, dt)
    if parked != 0:
        new_speed = type(speed)(0.0)
    half = type(speed)(0.5)
    mid_speed = wp.where(parked != 0, new_speed, (speed + new_speed) * half)
    way = mid_speed * dt
    o = type(position)()
    turn = type(position)(o[0], o[1], way * wp.tan((steering + new_steering) * half) / d.wheelbase)
    new_R, new_position = increment(R, position, type(position)(way, o[1], o[2]), turn, type(speed)(1.0))
    return new_R, new_position, new_speed, new_steering


@wp.func
def drive(model: Any, state: Any, world: int, vehicle: int, command: Any, duration: wp.float64):
    """Advance a driven vehicle in short steps; one that has ended stands still."""
    agent = model.landmarks + vehicle
    limits = model.dynamics[vehicle]
    R = state.rotation[world, agent]
    position = state.position[world, agent]
    speed = state.speed[world, vehicle]
    steering = state.steering[world, vehicle]
    parked = state.ended[world, vehicle]
    steps = int(wp.ceil(duration / LONGEST_SUBSTEP))
    dt = type(speed)(duration / wp.float64(wp.max(steps, 1)))
    for _ in range(steps):
        R, position, speed, steering = bicycle_step(limits, R, position, speed, steering, command, dt, parked)
    o = type(position)()
    state.rotation[world, agent] = orthonormalise(R)
    state.position[world, agent] = position
    state.speed[world, vehicle] = speed
    state.steering[world, vehicle] = steering
    state.velocity[world, agent] = type(o)(speed, o[1], o[2])
    state.angular_velocity[world, agent] = type(o)(o[0], o[1], yaw_rate(limits, speed, steering))


@wp.func
def yaw_rate(d: Any, speed: Any, steering: Any):
    """Return the bicycle's yaw rate, rad/s."""
    return speed * wp.tan(steering) / d.wheelbase


@wp.func
def drive_through(model: Any, state: Any, world: int, vehicle: int, command: Any, tick: int):
    """Drive a vehicle through one camera tick, keeping its true twist at every odometry sample on the way.

    Sample m is taken at m / odometry_rate; those in (t_{tick-1}, t_tick] belong to this tick.
    """
    agent = model.landmarks + vehicle
    tick_end = wp.float64(tick) * model.camera_period
    now = wp.float64(tick - 1) * model.camera_period
    sample = state.odometry_samples[world, vehicle]
    taken = int(0)
    due = wp.float64(sample) * model.odometry_period
    while due <= tick_end + wp.float64(1.0e-9) and taken < model.samples_per_tick:
        drive(model, state, world, vehicle, command, wp.max(due - now, wp.float64(0.0)))
        state.sampled_velocity[world, vehicle, taken] = state.velocity[world, agent]
        state.sampled_angular_velocity[world, vehicle, taken] = state.angular_velocity[world, agent]
        taken += 1
        now = due
        due = wp.float64(sample + taken) * model.odometry_period
    drive(model, state, world, vehicle, command, wp.max(tick_end - now, wp.float64(0.0)))


@wp.func
def turn_camera(model: Any, state: Any, world: int, vehicle: int, command: Any):
    """Turn a vehicle's camera through one camera tick towards the angle that is asked for."""
    limits = model.dynamics[vehicle]
    if limits.pan_limit > type(limits.pan_limit)(0.0):
        pan = state.pan[world, vehicle]
        step = limits.pan_rate * type(pan)(model.camera_period)
        wanted = wp.clamp(command[PAN], -limits.pan_limit, limits.pan_limit)
        state.pan[world, vehicle] = pan + wp.clamp(wanted - pan, -step, step)


@wp.func
def move(model: Any, state: Any, world: int, tick: int):
    """Carry all truth of one world to the tick's end."""
    t = wp.float64(tick) * model.camera_period
    for agent in range(model.agents):
        if model.motion.kind[agent] == PRESCRIBED:
            prescribe(model, state, world, agent, t)
    for vehicle in range(model.vehicles):
        if model.motion.kind[model.landmarks + vehicle] == DRIVEN:
            command = command_in_force(model, state, world, vehicle, tick)
            drive_through(model, state, world, vehicle, command, tick)
            turn_camera(model, state, world, vehicle, command)
