"""The Kalman update of the zoo, with bearings linearised half way between prediction and correction.

Linearised at the prediction, gain and innovation depend on the same noise of odometry: ranges between vehicles that
hardly move against each other drift outwards; linearised at the correction, they drift inwards; half way the drift
vanishes, as a Stratonovich integral has none (docs/robust.md tells of the experiment). Where a correction is so large
that half way is no good point at all, it is iterated to where it leads, which is Gauss-Newton: Bell and Cathey, The
iterated Kalman filter update as a Gauss-Newton method, IEEE Transactions on Automatic Control 38(2), 1993.
"""

from collections.abc import Callable

import numpy as np

from coopenv.estimation.arrays import Array, solve

FAR = 0.05
"""rad, by which a correction turns a line of sight and is large; what `robust` has, see robust/constants.py."""
CLOSE = 1e-4  # rad, by which an iteration to the end may still turn a line of sight
MOST = 8  # linearisations

Stacked = tuple[Array, Array, Array]
"""Residual (k,), its derivative H (k, n) by the error about the prediction, and its covariance N (k, k)."""


def gain(P: Array, H: Array, N: Array, residual: Array) -> tuple[Array, Array, float]:
    """Return (K, dx, r^T S^-1 r) of a Kalman update with measurement covariance N."""
    PHt = P.dot(H.T)
    solved = solve(H.dot(PHt) + N, np.concatenate([PHt.T, residual[:, None]], axis=1))
    K = solved[:, :-1].T
    return K, K.dot(residual), float(residual.dot(solved[:, -1]))


def joseph(P: Array, K: Array, H: Array, N: Array) -> Array:
    """Return the covariance after an update with any gain K."""
    A = -K.dot(H)
    A.flat[:: len(P) + 1] += 1.0
    P = A.dot(P).dot(A.T) + K.dot(N).dot(K.T)
    return np.asarray((P + P.T) / 2)


def kalman(P: Array, H: Array, N: Array, residual: Array) -> tuple[Array, Array, float]:
    """Return (dx, P+, r^T S^-1 r) of a Kalman update with measurement covariance N, in Joseph's form."""
    K, dx, nis = gain(P, H, N, residual)
    return dx, joseph(P, K, H, N), nis


def turn_of_sight(dx: Array, distance: float) -> float:
    """Return by how much an error (6n,) of n poses turns the line of sight to a point at a distance in m, rad."""
    size = np.abs(dx).reshape(-1, 2, 3).max(axis=(0, 2))
    return float(max(size[0], size[1] / distance))


def settled(
    P: Array,
    first: Stacked,
    look: Callable[[Array], Stacked],
    bend: Callable[[Array], float],
    to_the_end: bool = False,
) -> tuple[Array, Array, float]:
    """Return (dx, P+, r^T S^-1 r at the prediction) of an update linearised where it ought to be.

    Args:
        P: (n, n) before.
        first: the measurements linearised at the prediction.
        look: returns them linearised at the prediction moved by an error (n,), H still by the error about the
            prediction.
        bend: returns by how much an error (n,) turns a line of sight, rad.
        to_the_end: whether to linearise at the correction even where that is near.
    """
    residual, H, N = first
    K, dx, nis = gain(P, H, N, residual)
    at = np.zeros_like(dx)
    for step in range(1, MOST):
        where = dx if to_the_end or bend(dx) > FAR else 0.5 * dx
        if step > 1 and bend(where - at) < (CLOSE if to_the_end else FAR):
            break
        at = where
        residual, H, N = look(at)
        K, dx, _ = gain(P, H, N, residual + H.dot(at))
    return dx, joseph(P, K, H, N), nis
