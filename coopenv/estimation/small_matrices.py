"""Linear algebra of a few rows, by LAPACK itself: NumPy's own calls take several times as long."""

from __future__ import annotations

import numpy as np
from scipy.linalg.lapack import dgesv, dposv, dpotrf

from coopenv.estimation.arrays import Array


def solve(A: Array, b: Array) -> Array:
    """Return A^-1 b.

    Raises:
        LinAlgError: A is singular.
    """
    _, _, x, failed = dgesv(A, b)
    if failed:
        raise np.linalg.LinAlgError("singular matrix")
    result: Array = x
    return result


def cholesky(A: Array) -> Array:
    """Return the lower triangular L of A = L L^T.

    Raises:
        LinAlgError: A is not positive definite.
    """
    factor, failed = dpotrf(A, lower=True)
    if failed:
        raise np.linalg.LinAlgError("not positive definite")
    result: Array = factor
    return result


def solve_positive(A: Array, b: Array) -> Array:
    """Return A^-1 b of a positive definite A.

    Raises:
        LinAlgError: A is not positive definite.
    """
    _, x, failed = dposv(A, b)
    if failed:
        raise np.linalg.LinAlgError("not positive definite")
    result: Array = x
    return result


def invert_positive(A: Array) -> Array:
    """Return A^-1 of a positive definite A, symmetric.

    Raises:
        LinAlgError: A is not positive definite.
    """
    inverse = solve_positive(A, np.eye(len(A)))
    return (inverse + inverse.T) / 2
