"""Commands, and what all drives share: limits, dead band and lags of their actuators.

A command is made once per decision from an action in [-1, 1] and the vehicle's limits. Its first four entries follow
ROS' AckermannDrive: target speed (m/s), turning (of the kind: steering angle, rad, or turn rate, rad/s; positive to the
left), largest change of speed (m/s^2), and the camera's pan angle (rad, positive to the left). The fifth one is the
target of the lateral speed (m/s, positive to the left).
"""

from typing import Any

import warp as wp

SPEED = wp.constant(0)
TURN = wp.constant(1)
ACCELERATION = wp.constant(2)
PAN = wp.constant(3)
LATERAL = wp.constant(4)
"""Entries of a command."""


@wp.func
def sanitised(level: Any):
    """Return an entry of an action clipped to [-1, 1], zero where it is not finite."""
    one = type(level)(1.0)
    if wp.isfinite(level):
        return wp.clamp(level, -one, one)
    return type(level)(0.0)


@wp.func
def command_of(d: Any, first: Any, turn: Any, lateral: Any, pan: Any):
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
    return wp.vector(speed, turn * d.action_turn, acceleration, pan * d.pan_limit, lateral * d.max_lateral_speed)


@wp.func
def gradually(d: Any, command: Any, before: Any, duration: Any):
    """Return a command that differs from the one before by no more than is permitted in a decision's duration, s."""
    step = command[ACCELERATION] * duration
    turn = d.max_turn_change * duration
    command[SPEED] = wp.clamp(command[SPEED], before[SPEED] - step, before[SPEED] + step)
    command[TURN] = wp.clamp(command[TURN], before[TURN] - turn, before[TURN] + turn)
    command[LATERAL] = wp.clamp(command[LATERAL], before[LATERAL] - step, before[LATERAL] + step)
    return command


@wp.func
def first_order_lag(value: Any, target: Any, dt: Any, lag: Any, rate: Any):
    """Return the value after a first-order lag towards a target, its rate limited."""
    change = target - value
    if lag > type(lag)(0.0):
        change = change * (type(lag)(1.0) - wp.exp(-dt / lag))
    return value + wp.clamp(change, -rate * dt, rate * dt)


@wp.func
def actuate(d: Any, speed: Any, turn: Any, lateral: Any, command: Any, dt: Any):
    """Return (speed, turn, lateral speed) after dt under a command and the limits `d`."""
    wanted = command[SPEED]
    if wp.abs(wanted) < d.dead_band:
        wanted = type(wanted)(0.0)
    new_speed = first_order_lag(speed, wanted, dt, d.speed_time_constant, command[ACCELERATION])
    target = wp.clamp(command[TURN], -d.max_turn, d.max_turn)
    new_turn = first_order_lag(turn, target, dt, d.turn_time_constant, d.max_turn_change)
    new_lateral = lateral
    if d.max_lateral_speed > type(lateral)(0.0):
        aside = wp.clamp(command[LATERAL], -d.max_lateral_speed, d.max_lateral_speed)
        new_lateral = first_order_lag(lateral, aside, dt, d.speed_time_constant, command[ACCELERATION])
    return wp.clamp(new_speed, d.min_speed, d.max_speed), new_turn, new_lateral
