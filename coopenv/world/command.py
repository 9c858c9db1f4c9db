"""Commands in SI units, made once per decision from an action in [-1, 1] and the vehicle's limits.

A command says what ROS' AckermannDrive says: the speed to reach (m/s), the steering angle (rad, positive to the left),
and the acceleration (m/s^2) that the speed changes with at most. It is a vector with these three entries.
"""

from typing import Any

import warp as wp

from coopenv.world.collision import UNDER_WAY

SPEED = wp.constant(0)
STEERING = wp.constant(1)
ACCELERATION = wp.constant(2)
"""Entries of a command."""


@wp.func
def sanitised(action: Any):
    """Return an action clipped to [-1, 1], zero where it is not finite."""
    one = action.dtype(1.0)
    result = type(action)()
    for axis in range(2):
        if wp.isfinite(action[axis]):
            result[axis] = wp.clamp(action[axis], -one, one)
        else:
            result[axis] = action.dtype(0.0)
    return result


@wp.func
def command_of(d: Any, action: Any):
    """Return what an action in [-1, 1]^2 asks of a vehicle with the dynamics `d`.

    Where the first entry means an acceleration, the speed to reach is a limit of the vehicle: the highest or, to
    brake, the lowest.
    """
    one = action.dtype(1.0)
    acceleration = d.max_acceleration
    if d.acceleration_mode == 1:
        acceleration = wp.abs(action[0] * d.max_acceleration)
        speed = wp.where(action[0] < action.dtype(0.0), d.min_speed, d.max_speed)
    else:
        span = (d.max_speed - d.min_speed) * action.dtype(0.5)
        speed = d.min_speed + (action[0] + one) * span
    return wp.vector(speed, action[1] * d.action_steering, acceleration)


@wp.func
def decide(model: Any, state: Any, actions: Any, world: int):
    """Turn the actions of a decision that begins into commands; who has ended is to stand."""
    for vehicle in range(model.vehicles):
        action = sanitised(actions[world, vehicle])
        command = command_of(model.dynamics[vehicle], action)
        if state.ended[world, vehicle] != UNDER_WAY:
            command[SPEED] = action.dtype(0.0)
            command[ACCELERATION] = model.dynamics[vehicle].max_acceleration
        state.action[world, vehicle] = action
        state.command[world, vehicle] = command


@wp.func
def command_in_force(model: Any, state: Any, world: int, vehicle: int, tick: int):
    """Return what the actuators follow during a tick: after a decision, the last command for the dead time."""
    if (tick - 1) % model.ticks_per_decision < model.dynamics[vehicle].latency_ticks:
        return state.last_command[world, vehicle]
    return state.command[world, vehicle]
