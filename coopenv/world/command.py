"""Commands in SI units, made once per decision from an action in [-1, 1] and the vehicle's limits.

A command says what ROS' AckermannDrive says: the speed to reach (m/s), the steering angle (rad, positive to the left),
and the acceleration (m/s^2) that the speed changes with at most; and the camera's pan angle (rad, positive to the
left). It is a vector with these four entries.
"""

from typing import Any

import warp as wp

from coopenv.world.collision import UNDER_WAY

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
    """Return what the entries of an action in [-1, 1] ask of a vehicle with the dynamics `d`.

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


@wp.func
def decide(model: Any, state: Any, actions: Any, world: int):
    """Turn the actions of a decision that begins into commands; who has ended is to stand."""
    for vehicle in range(model.vehicles):
        for k in range(model.action_size):
            state.action[world, vehicle, k] = sanitised(actions[world, vehicle, k])
        first = state.action[world, vehicle, 0]
        pan = type(first)(0.0)
        if model.action_size > 2:
            pan = state.action[world, vehicle, 2]
        command = command_of(model.dynamics[vehicle], first, state.action[world, vehicle, 1], pan)
        if model.dynamics[vehicle].gated == 1:
            duration = type(first)(model.camera_period) * type(first)(model.ticks_per_decision)
            command = gradually(model.dynamics[vehicle], command, state.last_command[world, vehicle], duration)
        if state.ended[world, vehicle] != UNDER_WAY:
            command[SPEED] = type(first)(0.0)
            command[ACCELERATION] = model.dynamics[vehicle].max_acceleration
        state.command[world, vehicle] = command


@wp.func
def command_in_force(model: Any, state: Any, world: int, vehicle: int, tick: int):
    """Return what the actuators follow during a tick: after a decision, the last command for the dead time."""
    if (tick - 1) % model.ticks_per_decision < model.dynamics[vehicle].latency_ticks:
        return state.last_command[world, vehicle]
    return state.command[world, vehicle]
