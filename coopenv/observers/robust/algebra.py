"""Errors of poses, their transport, and 6x6 systems, in float64."""

from __future__ import annotations

from typing import Any

import warp as wp

from coopenv.estimation.linalg import eigen_symmetric6
from coopenv.estimation.so3 import quaternion_vector, rotation_vector_sine, skew
from coopenv.observers.robust.constants import KNOWN_ANGLE, KNOWN_POSITION, MIN_ANGULAR_VELOCITY_STD, MIN_VELOCITY_STD
from coopenv.observers.robust.types import lower_blocks, mat66d, stacked, vec3d

KNOWN_ANGLE_VARIANCE = KNOWN_ANGLE**2
KNOWN_POSITION_VARIANCE = KNOWN_POSITION**2
BEYOND = -0.9
"""Cosine of an angle from which on the skew part of a rotation says little of its axis."""


@wp.func
def log_so3(R: Any):
    """Return the rotation vector of R, of length 0..pi rad."""
    v = rotation_vector_sine(R, vec3d())
    sine = wp.length(v)
    cosine = wp.float64(0.5) * (wp.trace(R) - wp.float64(1.0))
    if cosine > wp.float64(BEYOND):
        if sine > wp.float64(1.0e-9):
            return v * (wp.atan2(sine, cosine) / sine)
        return v
    vector = quaternion_vector(R, v)
    length = wp.length(vector)
    return vector * (wp.float64(2.0) * wp.atan2(length, wp.float64(0.5) * sine / length) / length)


@wp.func
def left_error(R: Any, p: Any, R_other: Any, p_other: Any):
    """Return the left error (theta, rho) of the other pose against (R, p)."""
    Rt = wp.transpose(R)
    return stacked(log_so3(Rt * R_other), Rt * (p_other - p))


@wp.func
def transition(dR: Any, dp: Any):
    """Return F of the left error over an odometry increment."""
    E = wp.transpose(dR)
    return lower_blocks(E, -E * skew(dp), E)


@wp.func
def odometry_variances(model: Any, dt: Any):
    """Return the variances (rotation, translation) per axis of an odometry increment over dt."""
    scale = model.odometry_period * dt
    angular = wp.max(wp.float64(model.noise.angular_velocity), wp.float64(MIN_ANGULAR_VELOCITY_STD))
    linear = wp.max(wp.float64(model.noise.velocity), wp.float64(MIN_VELOCITY_STD))
    return angular * angular * scale, linear * linear * scale


@wp.func
def with_noise(P: Any, rotation: Any, translation: Any):
    """Return the symmetric part of P with variances added to its diagonal."""
    result = (P + wp.transpose(P)) * wp.float64(0.5)
    for i in range(3):
        result[i, i] = result[i, i] + rotation
        result[i + 3, i + 3] = result[i + 3, i + 3] + translation
    return result


@wp.func
def is_known(P: Any):
    """Return whether a pose of covariance P is certain enough to linearise about and to tell others."""
    for i in range(3):
        if not (P[i, i] < wp.float64(KNOWN_ANGLE_VARIANCE) and P[i + 3, i + 3] < wp.float64(KNOWN_POSITION_VARIANCE)):
            return False
    return True


@wp.func
def is_regular(M: Any, least: Any):
    """Return whether the smallest eigenvalue of a symmetric M exceeds a share of the largest."""
    identity = mat66d()
    for k in range(6):
        identity[k, k] = wp.float64(1.0)
    D, _ = eigen_symmetric6(M, identity)
    low = D[0, 0]
    high = D[0, 0]
    for k in range(6):
        low = wp.min(low, D[k, k])
        high = wp.max(high, D[k, k])
    return low > least * high


@wp.func
def inverse6(A: Any):
    """Return the inverse of a 6x6 matrix, by Gauss-Jordan elimination with partial pivoting."""
    M = A
    X = mat66d()
    for i in range(6):
        X[i, i] = wp.float64(1.0)
    for k in range(6):
        best = int(k)
        for i in range(k + 1, 6):
            if wp.abs(M[i, k]) > wp.abs(M[best, k]):
                best = i
        if best != k:
            for j in range(6):
                kept = M[k, j]
                M[k, j] = M[best, j]
                M[best, j] = kept
                kept = X[k, j]
                X[k, j] = X[best, j]
                X[best, j] = kept
        scale = wp.float64(1.0) / M[k, k]
        for j in range(6):
            M[k, j] = M[k, j] * scale
            X[k, j] = X[k, j] * scale
        for i in range(6):
            if i != k:
                factor = M[i, k]
                for j in range(6):
                    M[i, j] = M[i, j] - factor * M[k, j]
                    X[i, j] = X[i, j] - factor * X[k, j]
    return X


@wp.func
def distance_squared(e: Any, P: Any):
    """Return e^T P^-1 e."""
    return wp.dot(e, inverse6(P) * e)
