"""Stage 1: the truth moves from one camera tick to the next, by its script or by commands."""

from __future__ import annotations

from typing import Any

import warp as wp

from coopenv.world.command import command_in_force
from coopenv.world.dynamics import drive, prescribe
from coopenv.world.model import DRIVEN, PRESCRIBED


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
