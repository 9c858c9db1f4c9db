"""Odometry: noisy body twists sampled at their own rate, summed up to one increment per camera tick.

A sample is held until the next one. The increment (dR, dp) over a tick is the exact composition of the held twists,
so an observer predicts once per tick and loses nothing against predicting at every sample.
"""

from typing import Any

import warp as wp

from coopenv.estimation.so3 import identity3, increment
from coopenv.world.dynamics import segment_at
from coopenv.world.lasting_errors import drift, with_errors
from coopenv.world.model import DRIVEN
from coopenv.world.parameters import ODOMETRY_NOISE
from coopenv.world.random import ODOMETRY, six_gaussians


@wp.func
def noisy_sample(model: Any, state: Any, world: int, vehicle: int, sample: int, v: Any, w: Any):
    """Return the measured (v, omega) of one odometry sample."""
    noise = model.noise[vehicle]
    if noise.velocity > v.dtype(0.0) or noise.angular_velocity > v.dtype(0.0):
        linear, angular = six_gaussians(state.seed[world], state.episode[world], sample, vehicle, ODOMETRY, v)
        factor = state.parameter[world, ODOMETRY_NOISE]
        v = v + noise.velocity * factor * linear
        w = w + noise.angular_velocity * factor * angular
    return v, w


@wp.func
def true_twist(model: Any, state: Any, world: int, vehicle: int, taken: int, t: wp.float64):
    """Return the true (v, omega) at the tick's sample number `taken`, which is due at time t."""
    agent = model.landmarks + vehicle
    v = state.velocity[world, agent]
    w = state.angular_velocity[world, agent]
    if model.motion.kind[agent] == DRIVEN:
        v = state.sampled_velocity[world, vehicle, taken]
        w = state.sampled_angular_velocity[world, vehicle, taken]
    else:
        pace = state.pace[world, agent]
        segment = segment_at(model, agent, t * wp.float64(pace))
        v = model.motion.linear[segment] * pace
        w = model.motion.angular[segment] * pace
    return v, w


@wp.func
def measure_odometry(model: Any, state: Any, world: int, vehicle: int, tick: int):
    """Take the odometry samples of one camera tick, whose motion is over, and sum them up to its increment."""
    drift(model, state, world, vehicle, tick)
    tick_end = wp.float64(tick) * model.camera_period
    now = wp.float64(tick - 1) * model.camera_period
    v = state.odometry_velocity[world, vehicle]
    w = state.odometry_angular_velocity[world, vehicle]
    sample = state.odometry_samples[world, vehicle]
    rotation = identity3(v)
    translation = type(v)()
    taken = int(0)
    due = wp.float64(sample) * model.odometry_period
    while due <= tick_end + wp.float64(1.0e-9) and taken < model.samples_per_tick:
        if due > now:
            rotation, translation = increment(rotation, translation, v, w, v.dtype(due - now))
        true_v, true_w = true_twist(model, state, world, vehicle, taken, due)
        true_v, true_w = with_errors(model, state, world, vehicle, true_v, true_w)
        v, w = noisy_sample(model, state, world, vehicle, sample, true_v, true_w)
        now = due
        taken += 1
        sample += 1
        due = wp.float64(sample) * model.odometry_period
    if tick_end > now:  # not so where the last sample falls on the frame
        rotation, translation = increment(rotation, translation, v, w, v.dtype(tick_end - now))
    state.odometry_velocity[world, vehicle] = v
    state.odometry_angular_velocity[world, vehicle] = w
    state.odometry_samples[world, vehicle] = sample
    state.increment_rotation[world, vehicle] = rotation
    state.increment_translation[world, vehicle] = translation
