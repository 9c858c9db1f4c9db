"""The pipeline of one camera tick, and the kernels that run it for every world."""

from __future__ import annotations

from typing import Any

import warp as wp

from coopenv.observers.riccati.kernels import estimate
from coopenv.world.camera import observe
from coopenv.world.collision import referee
from coopenv.world.dynamics import prescribe
from coopenv.world.model import PRESCRIBED
from coopenv.world.odometry import measure_motion
from coopenv.world.reset import reset_world
from coopenv.world.v2x import broadcast, deliver


@wp.func
def sound(action: Any):
    """Return an action clipped to [-1, 1], zero where it is not finite."""
    one = action.dtype(1.0)
    result = action - action
    for axis in range(2):
        if wp.isfinite(action[axis]):
            result[axis] = wp.clamp(action[axis], -one, one)
        else:
            result[axis] = one - one
    return result


@wp.func
def command_in_force(model: Any, state: Any, world: int, vehicle: int, action: Any, tick: int):
    """Return what the actuators follow during a tick: after a decision, the last command for the dead time."""
    if (tick - 1) % model.ticks_per_decision < model.dynamics.latency_ticks:
        return state.command[world, vehicle]
    return action


@wp.func
def move(model: Any, state: Any, actions: Any, world: int, tick: int):
    """Carry all truth of one world to the tick's end and sample odometry on the way."""
    t = wp.float64(tick) * model.camera_period
    for agent in range(model.agents):
        if model.motion.kind[agent] == PRESCRIBED:
            prescribe(model, state, world, agent, t)
    for vehicle in range(model.vehicles):
        action = sound(actions[world, vehicle])
        command = command_in_force(model, state, world, vehicle, action, tick)
        measure_motion(model, state, world, vehicle, command, tick)


@wp.func
def sense(model: Any, state: Any, actions: Any, world: int, tick: int):
    """Move the truth of one world to a tick and measure it: everything that does not depend on any estimate."""
    move(model, state, actions, world, tick)
    for vehicle in range(model.vehicles):
        referee(model, state, world, vehicle)
    for vehicle in range(model.vehicles):
        observe(model, state, world, vehicle, tick)


@wp.func
def finish(model: Any, state: Any, actions: Any, world: int, tick: int):
    """Put a decision that is over on record, and count the tick."""
    if tick % model.ticks_per_decision == 0 or tick == model.horizon_ticks:
        for vehicle in range(model.vehicles):
            state.command[world, vehicle] = sound(actions[world, vehicle])
    state.tick[world] = tick


@wp.func
def tick_world(model: Any, state: Any, actions: Any, world: int):
    """Run one camera tick of one world: truth -> camera -> V2X -> observer -> V2X, leaders before followers."""
    tick = state.tick[world] + 1
    sense(model, state, actions, world, tick)
    for place in range(model.vehicles):
        vehicle = model.order[place]
        deliver(model, state, world, vehicle, tick)
        estimate(model, state, world, vehicle, tick)
        broadcast(model, state, world, vehicle, tick)
    finish(model, state, actions, world, tick)


def advance_kernel(model: Any, state: Any, actions: wp.array2d(dtype=Any), hold: wp.array(dtype=wp.int32), ticks: int):
    """Advance every world by up to `ticks` camera ticks, not beyond the horizon. One thread per world.

    Worlds marked in `hold` stay as they are.
    """
    world = wp.tid()
    count = wp.where(hold[world] == 0, wp.min(ticks, model.horizon_ticks - state.tick[world]), 0)
    for _ in range(count):
        tick_world(model, state, actions, world)


def reset_kernel(model: Any, state: Any, mask: wp.array(dtype=wp.int32)):
    """Start the next episode in every world whose mask is set. One thread per world."""
    world = wp.tid()
    if mask[world] != 0:
        state.episode[world] = state.episode[world] + wp.uint32(1)
        reset_world(model, state, world)
