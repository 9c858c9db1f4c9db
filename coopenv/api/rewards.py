"""Named reward terms and their weighted sum, as Warp functions."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from coopenv.scenario import Scenario
from coopenv.scenario.learning import RewardWeights
from coopenv.world.collision import ARRIVED, COLLIDED

TERMS = tuple(RewardWeights.model_fields)
"""Names of the terms, in the order of every term axis."""

PROGRESS = wp.constant(TERMS.index("progress"))
ARRIVAL = wp.constant(TERMS.index("arrival"))
COLLISION = wp.constant(TERMS.index("collision"))
CONTROL = wp.constant(TERMS.index("control"))
TIME = wp.constant(TERMS.index("time"))
POSITION_ERROR = wp.constant(TERMS.index("position_error"))
ORIENTATION_ERROR = wp.constant(TERMS.index("orientation_error"))
UNCERTAINTY = wp.constant(TERMS.index("uncertainty"))
OBSERVABILITY = wp.constant(TERMS.index("observability"))
VISIBILITY = wp.constant(TERMS.index("visibility"))
COUNT = wp.constant(len(TERMS))


def reward_weights(scenario: Scenario) -> np.ndarray:
    """Return the weights in the order of `TERMS`, (len(TERMS),) float32."""
    return np.array([getattr(scenario.reward.weights, name) for name in TERMS], dtype=np.float32)


@wp.func
def write_terms(
    model: Any,
    state: Any,
    terms: wp.array3d(dtype=wp.float32),
    world: int,
    vehicle: int,
    progress: wp.float32,
    duration: wp.float32,
    just_ended: int,
    position_error: wp.float32,
    orientation_error: wp.float32,
    log_determinant: wp.float32,
    smallest_eigenvalue: wp.float32,
    in_view: int,
):
    """Write the terms of one decision step; `just_ended` is ARRIVED or COLLIDED in the step of that event."""
    command = state.command[world, vehicle]
    terms[world, vehicle, PROGRESS] = progress
    terms[world, vehicle, ARRIVAL] = wp.where(just_ended == ARRIVED, 1.0, 0.0)
    terms[world, vehicle, COLLISION] = wp.where(just_ended == COLLIDED, -1.0, 0.0)
    terms[world, vehicle, CONTROL] = -wp.float32(wp.dot(command, command))
    terms[world, vehicle, TIME] = -duration
    terms[world, vehicle, POSITION_ERROR] = -position_error
    terms[world, vehicle, ORIENTATION_ERROR] = -orientation_error
    terms[world, vehicle, UNCERTAINTY] = -log_determinant / 6.0
    terms[world, vehicle, OBSERVABILITY] = wp.log(wp.max(smallest_eigenvalue, 1.0e-9)) * 0.4342944819032518
    possible = wp.max(model.target_count[vehicle], 1)
    terms[world, vehicle, VISIBILITY] = wp.float32(in_view) / wp.float32(possible)


@wp.func
def weigh(terms: wp.array3d(dtype=wp.float32), weights: wp.array(dtype=wp.float32), world: int, vehicle: int):
    """Return the weighted sum of the terms."""
    total = float(0.0)
    for term in range(COUNT):
        total += weights[term] * terms[world, vehicle, term]
    return total
