"""Symmetric positive definite matrices."""

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
