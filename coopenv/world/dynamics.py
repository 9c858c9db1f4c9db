"""Motion of the true vehicles: commands of a decision, and the way to the next camera tick.

A motion is prescribed in closed form, or driven by a command; the kinds of motion are in `coopenv.motions`.
"""

from typing import Any

import warp as wp

from coopenv.estimation.linalg import orthonormalise, rigid_motion
from coopenv.motions import prescribed
from coopenv.motions.command import ACCELERATION, LATERAL, PAN, SPEED, command_of, gradually, sanitised
from coopenv.motions.dispatch import displacement, drive_step
from coopenv.world.model import DRIVEN, PRESCRIBED
from coopenv.world.route import UNDER_WAY
from coopenv.world.warp_internals import device_function, outlined


@outlined
def decide(model: Any, state: Any, actions: Any, world: int):
    """Turn the actions of a decision into commands; a vehicle whose episode has ended stops."""
    for vehicle in range(model.vehicles):
        state.bytes_sent[world, vehicle] = 0
        for k in range(model.action_size):
            state.action[world, vehicle, k] = sanitised(actions[world, vehicle, k])
        first = state.action[world, vehicle, 0]
        lateral = type(first)(0.0)
        if model.columns > 2:
            lateral = state.action[world, vehicle, 2]
        pan = type(first)(0.0)
        if model.pans == 1:
            pan = state.action[world, vehicle, model.columns]
        if model.dynamics[vehicle].in_traffic == 1:
            continue
        command = command_of(model.dynamics[vehicle], first, state.action[world, vehicle, 1], lateral, pan)
        if model.dynamics[vehicle].gated == 1:
            duration = type(first)(model.camera_period) * type(first)(model.ticks_per_decision)
            command = gradually(model.dynamics[vehicle], command, state.last_command[world, vehicle], duration)
        if state.ended[world, vehicle] != UNDER_WAY:
            command[SPEED] = type(first)(0.0)
            command[LATERAL] = type(first)(0.0)
            command[ACCELERATION] = model.dynamics[vehicle].max_acceleration
        state.command[world, vehicle] = command


@device_function
def command_in_force(model: Any, state: Any, world: int, vehicle: int, tick: int):
    """Return the command that the actuators follow during a tick: for the dead time after a decision, the last one."""
    if (tick - 1) % model.ticks_per_decision < model.dynamics[vehicle].latency_ticks:
        return state.last_command[world, vehicle]
    return state.command[world, vehicle]


LONGEST_SUBSTEP = wp.constant(wp.float64(0.0100001))  # s; a twist is held over no longer than this


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
    turned, travelled = prescribed.displacement(R, v, w, h)
    state.rotation[world, agent] = turned
    state.position[world, agent] = (
        state.start_position[world, agent] + R0 * model.motion.position[segment] + R * travelled
    )
    state.velocity[world, agent] = v * pace
    state.angular_velocity[world, agent] = w * pace


@device_function
def drive(model: Any, state: Any, world: int, vehicle: int, command: Any, duration: wp.float64):
    """Advance a driven vehicle in short steps; an absent vehicle, or one with an ended episode, stands still."""
    agent = model.landmarks + vehicle
    limits = model.dynamics[vehicle]
    R = state.rotation[world, agent]
    position = state.position[world, agent]
    speed = state.speed[world, vehicle]
    turn = state.turn[world, vehicle]
    lateral = state.lateral_speed[world, vehicle]
    parked = wp.where(state.present[world, agent] == 0, 1, state.ended[world, vehicle])
    steps = int(wp.ceil(duration / LONGEST_SUBSTEP))
    dt = type(speed)(duration / wp.float64(wp.max(steps, 1)))
    for _ in range(steps):
        R, position, speed, turn, lateral = drive_step(limits, R, position, speed, turn, lateral, command, dt, parked)
    state.rotation[world, agent] = orthonormalise(R)
    state.position[world, agent] = position
    state.speed[world, vehicle] = speed
    state.turn[world, vehicle] = turn
    state.lateral_speed[world, vehicle] = lateral
    second = type(speed)(wp.where(parked != 0, 0.0, 1.0))
    velocity, angular_velocity = displacement(limits, speed, turn, lateral, second, position)
    state.velocity[world, agent] = velocity
    state.angular_velocity[world, agent] = angular_velocity


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


@outlined
def move(model: Any, state: Any, world: int, vehicle: int, tick: int):
    """Carry the truth of a vehicle to the tick's end."""
    agent = model.landmarks + vehicle
    if model.motion.kind[agent] == PRESCRIBED:
        prescribe(model, state, world, agent, wp.float64(tick) * model.camera_period)
    elif model.motion.kind[agent] == DRIVEN:
        command = command_in_force(model, state, world, vehicle, tick)
        drive_through(model, state, world, vehicle, command, tick)
        turn_camera(model, state, world, vehicle, command)


@outlined
def remember(model: Any, state: Any, world: int, tick: int):
    """Keep the poses and twists of all agents at a tick, in worlds where some camera's frames have an age."""
    for slot in range(model.past):
        if tick == 0 or slot == tick % model.past:
            for agent in range(model.agents):
                state.past_rotation[world, agent, slot] = state.rotation[world, agent]
                state.past_position[world, agent, slot] = state.position[world, agent]
                state.past_velocity[world, agent, slot] = state.velocity[world, agent]
                state.past_angular_velocity[world, agent, slot] = state.angular_velocity[world, agent]


@device_function
def pose_before(model: Any, state: Any, world: int, agent: int, tick: int, age: Any):
    """Return the pose of an agent some time, s, before a tick.

    It follows by the twist at the nearest tick that is kept: exactly while that is constant.
    """
    R = state.rotation[world, agent]
    position = state.position[world, agent]
    if age != type(age)(0.0):
        back = wp.clamp(int(wp.round(age / type(age)(model.camera_period))), 0, wp.min(tick, model.past - 1))
        slot = (tick - back) % model.past
        R = state.past_rotation[world, agent, slot]
        position = state.past_position[world, agent, slot]
        since = age - type(age)(wp.float64(back) * model.camera_period)
        v = state.past_velocity[world, agent, slot]
        turn, way = rigid_motion(-since * state.past_angular_velocity[world, agent, slot], -since * v)
        position = position + R * way
        R = R * turn
    return R, position


@device_function
def move_landmarks(model: Any, state: Any, world: int, tick: int):
    """Carry the landmarks that move to the tick's end."""
    for landmark in range(model.landmarks):
        if model.motion.kind[landmark] == PRESCRIBED:
            prescribe(model, state, world, landmark, wp.float64(tick) * model.camera_period)
