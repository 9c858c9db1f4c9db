"""Commands and motion of the true vehicles.

A command is made once per decision from an action in [-1, 1] and the vehicle's limits. Its four entries follow ROS'
AckermannDrive: target speed (m/s), steering angle (rad, positive to the left), largest change of speed (m/s^2), and the
camera's pan angle (rad, positive to the left).

A motion is prescribed in closed form, or a kinematic bicycle with its actuators.
"""

from typing import Any

import warp as wp

from coopenv.estimation.linalg import increment, orthonormalise, rigid_motion
from coopenv.world.model import DRIVEN, PRESCRIBED
from coopenv.world.route import UNDER_WAY
from coopenv.world.warp_internals import device_function

SPEED = wp.constant(0)
STEERING = wp.constant(1)
ACCELERATION = wp.constant(2)
PAN = wp.constant(3)
"""Entries of a command."""


@wp.func
def sanitised(level: Any):
    """Return an entry of an action clipped to [-1, 1], zero where it is not finite."""
    one = type(level)(1.0)
    if wp.isfinite(level):
        return wp.clamp(level, -one, one)
    return type(level)(0.0)


@wp.func
def command_of(d: Any, first: Any, steering: Any, pan: Any):
    """Return the command of an action's entries in [-1, 1] to a vehicle with the dynamics `d`.

    Where the first entry means an acceleration, the speed to reach is a limit of the vehicle: the highest or, to
    brake, the lowest.
    """
    one = type(first)(1.0)
    acceleration = d.max_acceleration
    if d.acceleration_mode == 1:
        acceleration = wp.abs(first * d.max_acceleration)
        speed = wp.where(first < type(first)(0.0), d.min_speed, d.max_speed)
    else:
        span = (d.max_speed - d.min_speed) * type(first)(0.5)
        speed = d.min_speed + (first + one) * span
    return wp.vector(speed, steering * d.action_steering, acceleration, pan * d.pan_limit)


@wp.func
def gradually(d: Any, command: Any, before: Any, duration: Any):
    """Return a command that differs from the one before by no more than is permitted in a decision's duration, s."""
    step = command[ACCELERATION] * duration
    turn = d.max_steering_rate * duration
    command[SPEED] = wp.clamp(command[SPEED], before[SPEED] - step, before[SPEED] + step)
    command[STEERING] = wp.clamp(command[STEERING], before[STEERING] - turn, before[STEERING] + turn)
    return command


@device_function
def decide(model: Any, state: Any, actions: Any, world: int):
    """Turn the actions of a decision into commands; a vehicle whose episode has ended stops."""
    for vehicle in range(model.vehicles):
        state.bytes_sent[world, vehicle] = 0
        for k in range(model.action_size):
            state.action[world, vehicle, k] = sanitised(actions[world, vehicle, k])
        first = state.action[world, vehicle, 0]
        pan = type(first)(0.0)
        if model.pans == 1:
            pan = state.action[world, vehicle, 2]
        if model.dynamics[vehicle].in_traffic == 1:
            continue
        command = command_of(model.dynamics[vehicle], first, state.action[world, vehicle, 1], pan)
        if model.dynamics[vehicle].gated == 1:
            duration = type(first)(model.camera_period) * type(first)(model.ticks_per_decision)
            command = gradually(model.dynamics[vehicle], command, state.last_command[world, vehicle], duration)
        if state.ended[world, vehicle] != UNDER_WAY:
            command[SPEED] = type(first)(0.0)
            command[ACCELERATION] = model.dynamics[vehicle].max_acceleration
        state.command[world, vehicle] = command


@device_function
def command_in_force(model: Any, state: Any, world: int, vehicle: int, tick: int):
    """Return the command that the actuators follow during a tick: for the dead time after a decision, the last one."""
    if (tick - 1) % model.ticks_per_decision < model.dynamics[vehicle].latency_ticks:
        return state.last_command[world, vehicle]
    return state.command[world, vehicle]


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


@device_function
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


def follow_commands(
    wanted: wp.array3d(dtype=wp.float64),
    lags: wp.array2d(dtype=wp.float64),
    start: wp.float64,
    steps: wp.array2d(dtype=wp.float64),
    reached: wp.array3d(dtype=wp.float64),
):
    """Follow wanted speeds and steering angles (P, T, 2) over steps (P, T), s.

    The columns of lags (P, 6) are lag of speed and steering, s, rates up, down and of steering, and the highest speed.
    """
    p = wp.tid()
    speed = start
    steering = wp.float64(0.0)
    for k in range(wanted.shape[1]):
        dt = steps[p, k]
        rate = lags[p, 2]
        if wp.abs(wanted[p, k, 0]) < wp.abs(speed):
            rate = lags[p, 3]
        speed = wp.clamp(first_order_lag(speed, wanted[p, k, 0], dt, lags[p, 0], rate), -lags[p, 5], lags[p, 5])
        steering = first_order_lag(steering, wanted[p, k, 1], dt, lags[p, 1], lags[p, 4])
        reached[p, k, 0] = speed
        reached[p, k, 1] = steering


@wp.func
def actuate(d: Any, speed: Any, steering: Any, command: Any, dt: Any):
    """Return (speed, steering) after dt under a command and limits `d`, see `coopenv.world.dynamics`."""
    wanted = command[SPEED]
    if wp.abs(wanted) < d.dead_band:
        wanted = type(wanted)(0.0)
    new_speed = first_order_lag(speed, wanted, dt, d.speed_time_constant, command[ACCELERATION])
    angle = wp.clamp(command[STEERING], -d.max_steering, d.max_steering)
    new_steering = first_order_lag(steering, angle, dt, d.steering_time_constant, d.max_steering_rate)
    return wp.clamp(new_speed, d.min_speed, d.max_speed), new_steering


@wp.func
def bicycle_step(d: Any, R: Any, position: Any, speed: Any, steering: Any, command: Any, dt: Any, parked: int):
    """Return (R, position, speed, steering) after dt: rear-axle bicycle, its twist held at the mid-point."""
    new_speed, new_steering = actuate(d, speed, steering, command, dt)
    if parked != 0:
        new_speed = type(speed)(0.0)
    half = type(speed)(0.5)
    mid_speed = wp.where(parked != 0, new_speed, (speed + new_speed) * half)
    distance = mid_speed * dt
    o = type(position)()
    turn = type(position)(o[0], o[1], distance * wp.tan((steering + new_steering) * half) / d.wheelbase)
    new_R, new_position = increment(R, position, type(position)(distance, o[1], o[2]), turn, type(speed)(1.0))
    return new_R, new_position, new_speed, new_steering


@device_function
def drive(model: Any, state: Any, world: int, vehicle: int, command: Any, duration: wp.float64):
    """Advance a driven vehicle in short steps; an absent vehicle, or one with an ended episode, stands still."""
    agent = model.landmarks + vehicle
    limits = model.dynamics[vehicle]
    R = state.rotation[world, agent]
    position = state.position[world, agent]
    speed = state.speed[world, vehicle]
    steering = state.steering[world, vehicle]
    parked = wp.where(state.present[world, agent] == 0, 1, state.ended[world, vehicle])
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


@device_function
def drive_through(model: Any, state: Any, world: int, vehicle: int, command: Any, tick: int):
    """Drive a vehicle through one camera tick, keeping its true twist at every odometry sample.

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


@device_function
def turn_camera(model: Any, state: Any, world: int, vehicle: int, command: Any):
    """Turn a vehicle's camera through one camera tick towards the commanded angle."""
    limits = model.dynamics[vehicle]
    if limits.pan_limit > type(limits.pan_limit)(0.0):
        pan = state.pan[world, vehicle]
        step = limits.pan_rate * type(pan)(model.camera_period)
        wanted = wp.clamp(command[PAN], -limits.pan_limit, limits.pan_limit)
        state.pan[world, vehicle] = pan + wp.clamp(wanted - pan, -step, step)


@device_function
def move(model: Any, state: Any, world: int, vehicle: int, tick: int):
    """Carry the truth of a vehicle to the tick's end."""
    agent = model.landmarks + vehicle
    if model.motion.kind[agent] == PRESCRIBED:
        prescribe(model, state, world, agent, wp.float64(tick) * model.camera_period)
    elif model.motion.kind[agent] == DRIVEN:
        command = command_in_force(model, state, world, vehicle, tick)
        drive_through(model, state, world, vehicle, command, tick)
        turn_camera(model, state, world, vehicle, command)


@device_function
def move_landmarks(model: Any, state: Any, world: int, tick: int):
    """Carry the landmarks that move to the tick's end."""
    for landmark in range(model.landmarks):
        if model.motion.kind[landmark] == PRESCRIBED:
            prescribe(model, state, world, landmark, wp.float64(tick) * model.camera_period)
