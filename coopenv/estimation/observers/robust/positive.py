"""Positive definite matrices of a few rows, by Cholesky factors; NumPy's own calls take several times as long."""

from __future__ import annotations

import numpy as np
from scipy.linalg.lapack import dposv, dpotrf, dpotri

from coopenv.estimation.observers.base import Array


def solve_positive(A: Array, b: Array) -> Array:
    """Return A^-1 b.

    Raises:
        LinAlgError: A is not positive definite.
    """
    _, x, failed = dposv(A, b)
    if failed:
        raise np.linalg.LinAlgError("not positive definite")
    return x


def invert_positive(A: Array) -> Array:
    """Return A^-1, symmetric.

    Raises:
        LinAlgError: A is not positive definite.
    """
    factor, failed = dpotrf(A)
    if failed:
        raise np.linalg.LinAlgError("not positive definite")
    upper, _ = dpotri(factor)  # below the diagonal are zeros
    inverse = upper + upper.T
    inverse.flat[:: len(A) + 1] *= 0.5
    return inverse
