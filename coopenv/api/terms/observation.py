"""The fields of coopenv's observation as Warp functions, one for every row of the table `OBSERVATION_FIELDS`.

They return the value in the row's unit; scaling and clipping follow. Records: see `coopenv.api.terms.records`.
"""

from __future__ import annotations

from typing import Any

import warp as wp

EIGENVALUE_FLOOR = wp.constant(1.0e-9)
LOG10_E = wp.constant(0.4342944819032518)


@wp.func
def log10(value: wp.float32) -> wp.float32:
    """Return the decimal logarithm."""
    return wp.log(value) * LOG10_E


@wp.func
def estimate_position(ego: Any):
    return ego.position_estimate


@wp.func
def estimate_forward(ego: Any):
    R = ego.rotation_estimate
    return wp.vector(R[0, 0], R[1, 0], R[2, 0])


@wp.func
def estimate_left(ego: Any):
    R = ego.rotation_estimate
    return wp.vector(R[0, 1], R[1, 1], R[2, 1])


@wp.func
def covariance_diagonal(ego: Any):
    P = ego.covariance
    result = wp.vector(length=6, dtype=wp.float32)
    for i in range(6):
        result[i] = log10(wp.float32(P[i, i]))
    return result


@wp.func
def log_determinant(ego: Any):
    return ego.log_determinant / ego.covariance.dtype(6.0)


@wp.func
def gramian_min_eigenvalue(ego: Any):
    return log10(wp.max(wp.float32(ego.gramian_min_eigenvalue), EIGENVALUE_FLOOR))


@wp.func
def targets_in_view(ego: Any):
    return ego.targets_in_view


@wp.func
def bearings(ego: Any, target: Any):
    return target.bearing


@wp.func
def bearing_mask(ego: Any, target: Any):
    return target.in_view


@wp.func
def bearing_age(ego: Any, target: Any):
    return target.age


@wp.func
def velocity(ego: Any):
    return ego.velocity


@wp.func
def angular_velocity(ego: Any):
    return ego.angular_velocity


@wp.func
def odometry_age(ego: Any):
    return ego.odometry_age


@wp.func
def message_position(ego: Any, neighbour: Any):
    return neighbour.position


@wp.func
def message_forward(ego: Any, neighbour: Any):
    R = neighbour.rotation
    return wp.vector(R[0, 0], R[1, 0], R[2, 0])


@wp.func
def message_mask(ego: Any, neighbour: Any):
    return neighbour.heard


@wp.func
def message_age(ego: Any, neighbour: Any):
    return neighbour.age


@wp.func
def goal(ego: Any):
    return ego.goal
