"""Parameters of a world: factors that are drawn at its resets, depend on its difficulty, or have been set."""

from typing import Any

import warp as wp

from coopenv.scenario.learning import PARAMETERS
from coopenv.world.random import PARAMETER, random_words, uniform

_NUMBER = {name: number for number, name in enumerate(PARAMETERS)}

CAMERA_RANGE = wp.constant(_NUMBER["camera_range"])
BEARING_NOISE = wp.constant(_NUMBER["bearing_noise"])
ODOMETRY_NOISE = wp.constant(_NUMBER["odometry_noise"])
ODOMETRY_SCALE = wp.constant(_NUMBER["odometry_scale"])
GYRO_BIAS = wp.constant(_NUMBER["gyro_bias"])
SLIP_RATE = wp.constant(_NUMBER["slip"])
EXTRINSICS = wp.constant(_NUMBER["extrinsics"])
INITIAL_ERROR = wp.constant(_NUMBER["initial_error"])
LANDMARK_PRESENCE = wp.constant(_NUMBER["landmark_presence"])
V2X_LOSS = wp.constant(_NUMBER["v2x_loss"])
TRAFFIC_PACE = wp.constant(_NUMBER["traffic_pace"])
WANDER = wp.constant(_NUMBER["wander"])
"""Indices of the state's field `parameter`."""

COUNT = wp.constant(len(PARAMETERS))
NOT_SET = -1.0
"""In the state's field `parameter_set`: the factor is drawn."""


@wp.func
def draw_parameters(model: Any, state: Any, world: int):
    """Draw the factors of a world, but for those that somebody has set."""
    level = state.difficulty[world]
    one = type(level)(1.0)
    for k in range(COUNT):
        factor = state.parameter_set[world, k]
        if factor < type(level)(0.0):
            words = random_words(state.seed[world], state.episode[world], 0, k, PARAMETER)
            low = model.drawn.low[k]
            factor = low + (model.drawn.high[k] - low) * uniform(words[0], one)
            easy = model.drawn.easy[k]
            factor = factor * (easy + (model.drawn.hard[k] - easy) * level)
        state.parameter[world, k] = factor
