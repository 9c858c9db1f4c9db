"""Symmetric positive definite matrices, and tangent planes."""

import numpy as np
from scipy.linalg.lapack import dposv


def solve_positive(A: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return A^-1 b of a positive definite A."""
    _, x, failed = dposv(A, b)
    if failed:
        raise np.linalg.LinAlgError("not positive definite")
    return x


def invert_positive(A: np.ndarray) -> np.ndarray:
    """Return A^-1 of a positive definite A, symmetric."""
    inverse = solve_positive(A, np.eye(len(A)))
    return (inverse + inverse.T) / 2


def condition(M: np.ndarray) -> float:
    """Return the product of the traces of a symmetric M and of its inverse, infinite where M is not positive."""
    spectrum = np.linalg.eigvalsh(M)
    return float(spectrum.sum() * (1.0 / spectrum).sum()) if spectrum[0] > 0.0 else np.inf


def tangent_basis(b: np.ndarray) -> np.ndarray:
    """Return (m, 2, 3) orthonormal rows across each unit vector b (m, 3).

    Source: Duff et al., Building an orthonormal basis, revisited, Journal of Computer Graphics Techniques 6(1), 2017.
    """
    x, y, z = b.T
    sign = np.copysign(1.0, z)
    a = -1.0 / (sign + z)
    c = x * y * a
    B = np.empty((len(b), 2, 3))
    B[:, 0, 0], B[:, 0, 1], B[:, 0, 2] = 1.0 + sign * x * x * a, sign * c, -sign * x
    B[:, 1, 0], B[:, 1, 1], B[:, 1, 2] = c, sign + y * y * a, -y
    return B
