"""The array type of NumPy code, and linear algebra of a few rows by LAPACK itself: NumPy takes several times longer."""

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dgesv, dpotrf

Array = NDArray[np.float64]


def solve(A: Array, b: Array) -> Array:
    """Return A^-1 b; a LinAlgError says that A is singular."""
    _, _, x, failed = dgesv(A, b)
    if failed:
        raise np.linalg.LinAlgError("singular matrix")
    return np.asarray(x)


def cholesky(A: Array) -> Array:
    """Return the lower triangular L of A = L L^T; a LinAlgError says that A is not positive definite."""
    factor, failed = dpotrf(A, lower=True)
    if failed:
        raise np.linalg.LinAlgError("not positive definite")
    return np.asarray(factor)
