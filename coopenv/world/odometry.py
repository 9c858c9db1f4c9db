"""Odometry: noisy body twists sampled at their own rate, summed up to one increment per camera tick.

A sample is held until the next one. The increment (dR, dp) over a tick is the exact composition of the held twists,
so an observer predicts once per tick and loses nothing against predicting at every sample.

Lasting errors (odometry scale, gyro bias, wheel slip, camera mounting, focal length, latency) are truth, drawn once per
vehicle and episode (`draw_errors`). Scale and bias walk, and slips come and go, from one camera tick to the next
(`drift`). With all of them off, nothing is drawn and nothing is changed.
"""

from typing import Any

import warp as wp

from coopenv.estimation.linalg import exp_so3, identity3, increment
from coopenv.world.dynamics import segment_at
from coopenv.world.model import DRIVEN
from coopenv.world.random import (
    EXTRINSICS,
    GYRO_BIAS,
    ODOMETRY,
    ODOMETRY_NOISE,
    ODOMETRY_SCALE,
    ODOMETRY_WALK,
    RESET_CAMERA,
    RESET_LENS,
    RESET_ODOMETRY,
    SLIP,
    SLIP_RATE,
    gaussian_pair,
    random_words,
    signed_uniform,
    six_gaussians,
    uniform,
)
from coopenv.world.warp_internals import device_function, outlined

SHORTEST = wp.constant(-0.9)
"""Least error of a focal length, relative: a lens stays a lens."""


@outlined
def draw_errors(model: Any, state: Any, world: int, vehicle: int):
    """Draw the errors of a vehicle's sensors for an episode; no wheel slips yet."""
    noise = model.noise[vehicle]
    camera = model.camera[vehicle]
    seed = state.seed[world]
    episode = state.episode[world]
    o = type(noise.gyro_bias)()
    scale = o
    bias = o
    if noise.lasting == 1:
        scale, bias = six_gaussians(seed, episode, 0, vehicle, RESET_ODOMETRY, o)
    turn = o
    shift = o
    if camera.orientation_std > o[0] or camera.position_std > o[0]:
        turn, shift = six_gaussians(seed, episode, 0, vehicle, RESET_CAMERA, o)
    focal = o[0]
    delay = o[0]
    if camera.focal_std > o[0] or camera.latency_std > o[0]:
        words = random_words(seed, episode, 0, vehicle, RESET_LENS)
        focal, delay = gaussian_pair(words[0], words[1], o.dtype(1.0))
    factor = state.parameter[world, EXTRINSICS]
    state.odometry_scale[world, vehicle] = noise.odometry_scale * state.parameter[world, ODOMETRY_SCALE] * scale[0]
    state.gyro_bias[world, vehicle] = wp.cw_mul(noise.gyro_bias, bias) * state.parameter[world, GYRO_BIAS]
    state.slip[world, vehicle] = type(state.slip[world, vehicle])()
    state.camera_turn[world, vehicle] = camera.orientation_std * factor * turn
    state.camera_shift[world, vehicle] = camera.position_std * factor * shift
    least = o.dtype(SHORTEST)
    state.camera_focal[world, vehicle] = wp.max(camera.focal_std * factor * focal, least)
    state.camera_delay[world, vehicle] = camera.latency_std * delay


@device_function
def drift(model: Any, state: Any, world: int, vehicle: int, tick: int):
    """Carry the errors of a vehicle's odometry from one camera tick to the next."""
    noise = model.noise[vehicle]
    if noise.lasting == 0:
        return
    o = type(noise.gyro_bias)()
    one = o.dtype(1.0)
    dt = o.dtype(model.camera_period)
    scale, bias = six_gaussians(state.seed[world], state.episode[world], tick, vehicle, ODOMETRY_WALK, o)
    scale = scale * state.parameter[world, ODOMETRY_SCALE]
    bias = bias * state.parameter[world, GYRO_BIAS]
    step = wp.sqrt(dt)
    state.odometry_scale[world, vehicle] += noise.odometry_scale_walk * step * scale[0]
    state.gyro_bias[world, vehicle] += wp.cw_mul(noise.gyro_bias_walk, bias) * step
    if noise.slip_rate > o[0]:
        slip = state.slip[world, vehicle]
        words = random_words(state.seed[world], state.episode[world], tick, vehicle, SLIP)
        slips = slip[0] != o[0] or slip[1] != o[0]
        rate = wp.where(slips, one / noise.slip_duration, noise.slip_rate * state.parameter[world, SLIP_RATE])
        if uniform(words[0], one) < one - wp.exp(-rate * dt):  # a Markov chain of two states
            slip = type(slip)()
            if not slips:
                slip[0] = noise.slip_size * uniform(words[1], one)
                slip[1] = noise.slip_angle * signed_uniform(words[2], one)
            state.slip[world, vehicle] = slip


@device_function
def with_errors(model: Any, state: Any, world: int, vehicle: int, v: Any, w: Any):
    """Return the noise-free readings of wheels and gyro for a body twist (v, w)."""
    if model.noise[vehicle].lasting == 0:
        return v, w
    o = type(v)()
    one = v.dtype(1.0)
    slip = state.slip[world, vehicle]
    read = v * ((one + state.odometry_scale[world, vehicle]) * (one + slip[0]))
    if slip[1] != o[0]:
        read = exp_so3(type(v)(o[0], o[0], slip[1])) * read
    return read, w + state.gyro_bias[world, vehicle]


@device_function
def noisy_sample(model: Any, state: Any, world: int, vehicle: int, sample: int, v: Any, w: Any):
    """Return the measured (v, omega) of one odometry sample."""
    noise = model.noise[vehicle]
    if noise.velocity > v.dtype(0.0) or noise.angular_velocity > v.dtype(0.0):
        linear, angular = six_gaussians(state.seed[world], state.episode[world], sample, vehicle, ODOMETRY, v)
        factor = state.parameter[world, ODOMETRY_NOISE]
        v = v + noise.velocity * factor * linear
        w = w + noise.angular_velocity * factor * angular
    return v, w


@device_function
def true_twist(model: Any, state: Any, world: int, vehicle: int, taken: int, t: wp.float64):
    """Return the true (v, omega) at the tick's sample number `taken`, which is due at time t."""
    agent = model.landmarks + vehicle
    if model.motion.kind[agent] == DRIVEN:
        return state.sampled_velocity[world, vehicle, taken], state.sampled_angular_velocity[world, vehicle, taken]
    pace = state.pace[world, agent]
    segment = segment_at(model, agent, t * wp.float64(pace))
    return model.motion.linear[segment] * pace, model.motion.angular[segment] * pace


@outlined
def measure_odometry(model: Any, state: Any, world: int, vehicle: int, tick: int):
    """Take the odometry samples of one camera tick after its motion and sum them to its increment."""
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
