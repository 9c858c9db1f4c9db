"""How good an estimate is, as Warp functions: errors, NEES, log-determinant, smallest Gramian eigenvalue."""

from __future__ import annotations

from typing import Any

import warp as wp

from coopenv.estimation.linalg import block3, cholesky6, join6, smallest_eigenvalue6
from coopenv.estimation.so3 import quaternion_vector
from coopenv.estimation.trajectory import Sight

VISIBLE = wp.constant(wp.uint8(Sight.VISIBLE))


@wp.func
def log_determinant(I11: Any, I22: Any):
    """Return log det P from the inverses of the diagonal blocks of its Cholesky factor."""
    total = I11.dtype(0.0)
    for i in range(3):
        total -= wp.log(I11[i, i]) + wp.log(I22[i, i])
    return I11.dtype(2.0) * total


@wp.func
def normalised_error_squared(I11: Any, L21: Any, I22: Any, e1: Any, e2: Any):
    """Return e^T P^-1 e for e = (e1, e2) and P = L L^T; a very large number where the precision has no room for it.

    NaN where the error is.
    """
    x1 = I11 * e1
    x2 = I22 * (e2 - L21 * x1)
    square = wp.dot(x1, x1) + wp.dot(x2, x2)
    if wp.isfinite(wp.dot(e1, e1) + wp.dot(e2, e2)) and not wp.isfinite(square):
        square = e1.dtype(1.0e18)
    return square


@wp.func
def observer_error(R: Any, position: Any, R_hat: Any, p_hat: Any):
    """Return (2 lambda, p - phat), the error coordinates of P: Rtilde = Rhat^T R, p = R^T pbar (paper, sec. IV)."""
    R_tilde = wp.transpose(R_hat) * R
    lam = quaternion_vector(R_tilde, p_hat)
    return lam * p_hat.dtype(2.0), wp.transpose(R) * position - p_hat


@wp.func
def gramian_smallest_eigenvalue(model: Any, state: Any, world: int, vehicle: int):
    """Return the smallest eigenvalue of (1/T) int Phi^T C^T C Phi dt over the sliding window; 0 before any data."""
    G11 = state.gramian_11[world, vehicle, 0]
    G12 = state.gramian_12[world, vehicle, 0]
    G22 = state.gramian_22[world, vehicle, 0]
    time = state.gramian_time[world, vehicle, 0]
    for block in range(1, model.observer.blocks):
        G11 += state.gramian_11[world, vehicle, block]
        G12 += state.gramian_12[world, vehicle, block]
        G22 += state.gramian_22[world, vehicle, block]
        time += state.gramian_time[world, vehicle, block]
    if time <= time - time:
        return time
    zero6 = state.covariance[world, vehicle] - state.covariance[world, vehicle]
    G = join6(G11, G12, wp.transpose(G12), G22, zero6)
    return smallest_eigenvalue6(G) / time


@wp.func
def cholesky_of(P: Any, zero3: Any):
    """Return (L11^-1, L21, L22^-1) of the Cholesky factor of a 6x6 covariance."""
    _, L21, _, I11, I22 = cholesky6(block3(P, 0, 0, zero3), block3(P, 0, 3, zero3), block3(P, 3, 3, zero3))
    return I11, L21, I22


@wp.func
def targets_in_view(model: Any, state: Any, world: int, vehicle: int) -> int:
    """Return how many targets the vehicle measures in this frame."""
    count = int(0)
    for n in range(model.target_count[vehicle]):
        if state.sight[world, vehicle, model.targets[vehicle, n]] == VISIBLE:
            count += 1
    return count
