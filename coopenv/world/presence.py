"""Who is in a scene: drawn at a reset, and changed by vehicles that leave. Who is absent is neither seen nor a body."""

from typing import Any

import warp as wp

from coopenv.world.model import DRIVEN, PRESCRIBED
from coopenv.world.parameters import LANDMARK_PRESENCE, TRAFFIC_PACE
from coopenv.world.random import PRESENCE, random_words, signed_uniform, uniform

ABSENT = wp.constant(-1)
"""Value of `ended` of a vehicle that is not there in this episode."""

EVERY_VEHICLE = wp.constant(-1)
"""As a subject of random numbers: all vehicles of a world."""


@wp.func
def draw_presence(model: Any, state: Any, world: int):
    """Draw who is there in an episode, and the pace of each prescribed motion."""
    one = type(model.routes.height)(1.0)
    for agent in range(model.agents):
        words = random_words(state.seed[world], state.episode[world], 0, agent, PRESENCE)
        chance = model.drawn.presence[agent]
        if agent < model.landmarks:
            chance = chance * state.parameter[world, LANDMARK_PRESENCE]
        state.present[world, agent] = wp.where(uniform(words[0], one) < chance, 1, 0)
        pace = one
        if model.motion.kind[agent] == PRESCRIBED:
            pace = one + model.drawn.pace_spread[agent] * signed_uniform(words[1], one)
            pace = pace * state.parameter[world, TRAFFIC_PACE]
        state.pace[world, agent] = pace
    keep_one_vehicle(model, state, world)
    for vehicle in range(model.vehicles):
        state.ended[world, vehicle] = wp.where(state.present[world, model.landmarks + vehicle] == 0, ABSENT, 0)


@wp.func
def keep_one_vehicle(model: Any, state: Any, world: int):
    """Let one of the vehicles stay where all are absent: a driven one if there is any."""
    candidates = int(0)
    for agent in range(model.landmarks, model.agents):
        if model.motion.kind[agent] == DRIVEN or model.drawn.any_driven == 0:
            candidates += 1
            if state.present[world, agent] != 0:
                return
    words = random_words(state.seed[world], state.episode[world], 0, EVERY_VEHICLE, PRESENCE)
    chosen = wp.min(int(uniform(words[0], wp.float64(1.0)) * wp.float64(candidates)), candidates - 1)
    for agent in range(model.landmarks, model.agents):
        if model.motion.kind[agent] == DRIVEN or model.drawn.any_driven == 0:
            if chosen == 0:
                state.present[world, agent] = 1
            chosen -= 1
