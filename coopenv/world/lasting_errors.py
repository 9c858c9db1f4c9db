"""Errors that last: of the odometry's scale, the gyro, slipping wheels, where the camera sits, and its lens.

They are truth, drawn once per vehicle and episode (`draw_errors`). Scale and bias then walk, and slips come and go,
from one camera tick to the next (`drift`). Where all are off, nothing is drawn and nothing is changed.
"""

from typing import Any

import warp as wp

from coopenv.estimation.so3 import exp_so3
from coopenv.world.parameters import EXTRINSICS, GYRO_BIAS, ODOMETRY_SCALE, SLIP_RATE
from coopenv.world.random import (
    ODOMETRY_WALK,
    RESET_CAMERA,
    RESET_LENS,
    RESET_ODOMETRY,
    SLIP,
    gaussian_pair,
    random_words,
    signed_uniform,
    six_gaussians,
    uniform,
)

SHORTEST = wp.constant(-0.9)
"""Least error of a focal length, relative: a lens stays a lens."""


@wp.func
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
    if camera.focal_std > o[0]:
        words = random_words(seed, episode, 0, vehicle, RESET_LENS)
        focal, _ = gaussian_pair(words[0], words[1], o.dtype(1.0))
    factor = state.parameter[world, EXTRINSICS]
    state.odometry_scale[world, vehicle] = noise.odometry_scale * state.parameter[world, ODOMETRY_SCALE] * scale[0]
    state.gyro_bias[world, vehicle] = wp.cw_mul(noise.gyro_bias, bias) * state.parameter[world, GYRO_BIAS]
    state.slip[world, vehicle] = type(state.slip[world, vehicle])()
    state.camera_turn[world, vehicle] = camera.orientation_std * factor * turn
    state.camera_shift[world, vehicle] = camera.position_std * factor * shift
    least = o.dtype(SHORTEST)
    state.camera_focal[world, vehicle] = wp.max(camera.focal_std * factor * focal, least)


@wp.func
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


@wp.func
def with_errors(model: Any, state: Any, world: int, vehicle: int, v: Any, w: Any):
    """Return what wheels and gyro read, free of noise, where the body's twist is (v, w)."""
    if model.noise[vehicle].lasting == 0:
        return v, w
    o = type(v)()
    one = v.dtype(1.0)
    slip = state.slip[world, vehicle]
    read = v * ((one + state.odometry_scale[world, vehicle]) * (one + slip[0]))
    if slip[1] != o[0]:
        read = exp_so3(type(v)(o[0], o[0], slip[1])) * read
    return read, w + state.gyro_bias[world, vehicle]
