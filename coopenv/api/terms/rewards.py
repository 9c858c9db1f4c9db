"""The terms of coopenv's reward as Warp functions, one for every row of the table `REWARD_TERMS`.

Those that are given `truth` are privileged. Records: see `coopenv.api.terms.records`.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from coopenv.api.terms.observation import gramian_min_eigenvalue
from coopenv.world.collision import ARRIVED, COLLIDED

DEGREES = wp.constant(57.29577951308232)


@wp.func
def progress(ego: Any, truth: Any):
    return truth.progress


@wp.func
def arrival(ego: Any):
    return wp.where(ego.outcome == ARRIVED, 1.0, 0.0)


@wp.func
def collision(ego: Any):
    return wp.where(ego.outcome == COLLIDED, -1.0, 0.0)


@wp.func
def control(ego: Any):
    return -wp.float32(wp.dot(ego.action, ego.action))


@wp.func
def time(ego: Any):
    return -ego.elapsed


@wp.func
def position_error(ego: Any, truth: Any):
    return -truth.position_error


@wp.func
def orientation_error(ego: Any, truth: Any):
    return -(truth.orientation_error / wp.float32(DEGREES))


@wp.func
def uncertainty(ego: Any):
    return -wp.float32(ego.log_determinant) / 6.0


observability = gramian_min_eigenvalue


@wp.func
def visibility(ego: Any):
    return wp.float32(ego.targets_in_view) / wp.float32(wp.max(ego.possible_targets, 1))
