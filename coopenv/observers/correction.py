"""The Kalman update of the zoo, with bearings linearised half way between prediction and correction.

Linearised at the prediction, gain and innovation depend on the same noise of odometry: ranges between vehicles that
hardly move against each other drift outwards; linearised at the correction, they drift inwards; half way the drift
vanishes, as a Stratonovich integral has none (docs/observers.md#linearisation has the comparison).

The other form is iterated to where the correction leads, which is Gauss-Newton: Bell and Cathey, The iterated Kalman
filter update as a Gauss-Newton method, IEEE Transactions on Automatic Control 38(2), 1993; with a line search as in
Skoglund, Hendeby and Axehill, Extended Kalman filter modifications based on an optimization view point, FUSION 2015.
"""

from collections.abc import Callable

import numpy as np

from coopenv.estimation.arrays import Array, solve
from coopenv.estimation.compiled import MATRIX, VECTOR, compiled
from coopenv.estimation.compiled_matrices import eliminated, place, transformed

CLOSE = 1e-3  # rad, by which the last step of an iteration may turn a line of sight
MOST = 8  # steps, and halvings of a step

Stacked = tuple[Array, Array, Array]
"""Residual (k,), its derivative H (k, n) by the error about the prediction, and its covariance N (k, k)."""

Look = Callable[[Array], Stacked]


@compiled(MATRIX, MATRIX, MATRIX, VECTOR)
def gain(P: Array, H: Array, N: Array, residual: Array) -> tuple[Array, Array, float]:
    """Return (K (n, k), dx (n,), r^T S^-1 r) of a Kalman update of P (n, n) by k numbers of covariance N (k, k)."""
    n, m = len(P), len(residual)
    H, right = np.ascontiguousarray(H), np.empty((m, n + 1))
    HP = H.dot(np.ascontiguousarray(P.T))
    place(right, 0, 0, HP)
    for k in range(m):
        right[k, n] = residual[k]
    solved = eliminated(HP.dot(H.T) + N, right)
    nis = 0.0
    for k in range(m):
        nis += residual[k] * solved[k, n]
    return solved[:, :n].T, transformed(solved[:, :n].T, residual), nis


@compiled(MATRIX, MATRIX, MATRIX, MATRIX)
def joseph(P: Array, K: Array, H: Array, N: Array) -> Array:
    """Return the covariance (n, n) after an update with any gain K (n, k)."""
    K = np.ascontiguousarray(K)
    A = np.eye(len(P)) - K.dot(np.ascontiguousarray(H))
    after: Array = A.dot(np.ascontiguousarray(P)).dot(A.T) + K.dot(np.ascontiguousarray(N)).dot(K.T)
    after = (after + after.T) / 2
    return after


def kalman(P: Array, H: Array, N: Array, residual: Array) -> tuple[Array, Array, float]:
    """Return (dx, P+, r^T S^-1 r) of a Kalman update with measurement covariance N, in Joseph's form."""
    K, dx, nis = gain(P, H, N, residual)
    return dx, joseph(P, K, H, N), nis


def turn_of_sight(dx: Array, distance: float) -> float:
    """Return by how much an error (6n,) of n poses turns the line of sight to a point at a distance in m, rad."""
    size = np.abs(dx).reshape(-1, 2, 3).max(axis=(0, 2))
    return float(max(size[0], size[1] / distance))


def halfway(P: Array, first: Stacked, look: Look) -> tuple[Array, Array, float]:
    """Return (dx, P+, r^T S^-1 r at the prediction) of an update linearised half way.

    Args:
        P: (n, n) before.
        first: the measurements linearised at the prediction.
        look: returns them linearised at the prediction moved by an error (n,), H still by the error about the
            prediction.
    """
    residual, H, N = first
    _, dx, nis = gain(P, H, N, residual)
    at = 0.5 * dx
    residual, H, N = look(at)
    K, dx, _ = gain(P, H, N, residual + H.dot(at))
    return dx, joseph(P, K, H, N), nis


def iterated(P: Array, first: Stacked, look: Look, bend: Callable[[Array], float]) -> tuple[Array, Array, float]:
    """Return what `halfway` does of an update iterated to where it leads.

    Steps are halved until the cost x^T P^-1 x + r^T N^-1 r falls. `bend` returns by how much an error (n,) turns a line
    of sight, rad.
    """

    def cost(x: Array, residual: Array, N: Array) -> float:
        return float(x.dot(solve(P, x)) + residual.dot(solve(N, residual)))

    at, (residual, H, N) = np.zeros(len(P)), first
    K, dx, nis = gain(P, H, N, residual)
    least = cost(at, residual, N)
    for _ in range(MOST):
        step = dx - at
        for _ in range(MOST):
            seen = look(at + step)
            reached = cost(at + step, seen[0], seen[2])
            if reached <= least:
                break
            step = 0.5 * step
        else:
            break
        at, least, (residual, H, N) = at + step, reached, seen
        K, dx, _ = gain(P, H, N, residual + H.dot(at))
        if bend(step) < CLOSE:
            break
    return at, joseph(P, K, H, N), nis
