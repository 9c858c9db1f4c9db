"""Linear algebra of a few rows, by LAPACK itself: NumPy's own calls take several times as long."""

import numpy as np
from scipy.linalg.lapack import dgesv, dpotrf

from coopenv.estimation.arrays import Array


def solve(A: Array, b: Array) -> Array:
    """Return A^-1 b; a LinAlgError says that A is singular."""
    _, _, x, failed = dgesv(A, b)
    if failed:
        raise np.linalg.LinAlgError("singular matrix")
    result: Array = x
    return result


def cholesky(A: Array) -> Array:
    """Return the lower triangular L of A = L L^T; a LinAlgError says that A is not positive definite."""
    factor, failed = dpotrf(A, lower=True)
    if failed:
        raise np.linalg.LinAlgError("not positive definite")
    result: Array = factor
    return result
