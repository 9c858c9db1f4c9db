"""The update of one pose by the bearings of a frame, linearised half way (correction.py), compiled."""

import numpy as np
from numba import types

from coopenv.estimation.arrays import Array
from coopenv.estimation.compiled import MATRICES, MATRIX, NUMBER, VECTOR, WHOLE, compiled
from coopenv.estimation.compiled_matrices import product, transformed
from coopenv.observers.contract import Tick
from coopenv.observers.correction import gain, joseph
from coopenv.observers.lines import Sight, dense, linearise
from coopenv.observers.pose_errors import RIGHT, corrected, moved, recentring

FRAME = types.Tuple((VECTOR, MATRIX, MATRIX, MATRICES, NUMBER))
"""Lever arm (3,), bearings (m, 3), points (m, 3), their covariances (m, 3, 3), and a bearing's variance."""
Frame = tuple[Array, Array, Array, Array, float]


def frame_of(tick: Tick, sight: Sight) -> Frame:
    """Return what compiled functions need of a frame."""
    return (
        np.asarray(tick.lever_arm, float),
        sight.bearings,
        sight.positions,
        sight.covariances,
        tick.noise.bearing_std**2,
    )


@compiled(WHOLE, MATRIX, VECTOR, FRAME)
def stacked(kind: int, R: Array, p: Array, frame: Frame) -> tuple[Array, Array, Array]:
    """Return residual (2m,), H (2m, 6) and N (2m, 2m) at a pose."""
    residual, H, N, _ = linearise(R, p, kind == RIGHT, *frame)
    return residual.ravel(), H.reshape(-1, 6), dense(N)


@compiled(WHOLE, MATRIX, VECTOR, MATRIX, FRAME)
def halfway_gain(kind: int, R: Array, p: Array, P: Array, frame: Frame) -> tuple[Array, Array, Array, Array, float]:
    """Return (K (6, 2m), H, N, dx (6,), r^T S^-1 r at the prediction) of the correction of a prediction.

    H (2m, 6) and N (2m, 2m) are those half way; P (6, 6) is the prediction's covariance, over the error of that kind.
    """
    residual, H, N = stacked(kind, R, p, frame)
    _, dx, nis = gain(P, H, N, residual)
    at = 0.5 * dx
    R, p = moved(kind, R, p, at)
    residual, H, N = stacked(kind, R, p, frame)
    H = product(H, recentring(kind, at))
    K, dx, _ = gain(P, H, N, residual + transformed(H, at))
    return K, H, N, dx, nis


@compiled(WHOLE, MATRIX, VECTOR, MATRIX, FRAME)
def updated(kind: int, R: Array, p: Array, P: Array, frame: Frame) -> tuple[Array, Array, Array, float]:
    """Return R (3, 3), p (3,) in m, P (6, 6) and r^T S^-1 r of the correction of a prediction of covariance P."""
    K, H, N, dx, nis = halfway_gain(kind, R, p, P, frame)
    R, p, P = corrected(kind, R, p, dx, joseph(P, K, H, N))
    return R, p, P, nis
