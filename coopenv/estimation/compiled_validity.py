"""Validity of poses and covariances, compiled: observers' estimates and messages are tested at every tick.

A value that passes is valid. For any other value `coopenv.observers.contract` decides, and names what is wrong.
"""

from typing import Any

import numpy as np

from coopenv.estimation.compiled import MATRIX, NUMBER, VECTOR, compiled
from coopenv.estimation.poses import Array
from coopenv.estimation.validity import MAX_BEND, MOST_LOPSIDED


def is_plain(value: Any, axes: int) -> bool:
    """Return whether a value is an array of float64 of so many axes, as the functions below take it."""
    return type(value) is np.ndarray and value.ndim == axes and value.dtype == np.float64


@compiled(VECTOR, NUMBER)
def is_position(p: Array, largest: float) -> bool:
    """Return whether it is a position (3,), of coordinates up to the largest."""
    return len(p) == 3 and abs(p[0]) <= largest and abs(p[1]) <= largest and abs(p[2]) <= largest


@compiled(MATRIX)
def is_rotation(R: Array) -> bool:
    """Return whether it is a rotation (3, 3)."""
    if R.shape != (3, 3):
        return False
    for i in range(3):
        for j in range(i + 1):
            entry = R[0, i] * R[0, j] + R[1, i] * R[1, j] + R[2, i] * R[2, j]
            if not abs(entry - (i == j)) <= MAX_BEND:
                return False
    x, y, z = R[1, 0] * R[2, 1], R[1, 1] * R[2, 2], R[1, 2] * R[2, 0]
    x, y, z = x - R[1, 1] * R[2, 0], y - R[1, 2] * R[2, 1], z - R[1, 0] * R[2, 2]
    determinant: float = R[0, 0] * y + R[0, 1] * z + R[0, 2] * x
    return determinant > 0.0


@compiled(MATRIX, NUMBER, NUMBER)
def is_covariance(P: Array, least: float, largest: float) -> bool:
    """Return whether it is symmetric, positive definite, and has variances from the least on and no larger entries."""
    n = len(P)
    if P.shape[1] != n:
        return False
    lopsided, size = 0.0, 0.0
    for i in range(n):
        if not least <= P[i, i] <= largest:
            return False
        for j in range(n):
            if not abs(P[i, j]) <= largest:
                return False
            lopsided += (P[i, j] - P[j, i]) ** 2
            size += P[i, j] ** 2
    if not lopsided <= MOST_LOPSIDED**2 * size:
        return False
    L = np.zeros((n, n))  # of P = L L^T
    for j in range(n):
        for i in range(j, n):
            rest = P[i, j]
            for k in range(j):
                rest -= L[i, k] * L[j, k]
            if i > j:
                L[i, j] = rest / L[j, j]
            elif rest > 0.0:
                L[j, j] = np.sqrt(rest)
            else:
                return False
    return True
