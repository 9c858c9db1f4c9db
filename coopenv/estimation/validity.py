"""Validity of arrays from outside: of a saved state, a recording or a tick."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coopenv.base.sections import LARGEST

Values = NDArray[Any]
Mask = NDArray[np.bool_]
Fields = Mapping[str, Values]

MAX_BEND = 1e-6
"""Tolerance of the entries of R^T R, and of the squared length of a direction."""
MOST_LOPSIDED = 1e-6
"""By how much a covariance and its transpose may differ, relative to it, in Frobenius' norm."""
MAX_ASYMMETRY = 1e-6
"""By how much entries of a covariance may differ from its transpose, relative to the standard deviations."""


class Rule(NamedTuple):
    """Condition on every element of an array of a saved state, a recording or a tick."""

    must_be: str  # in words, for errors
    holds: Callable[[Values, Fields, Any], Mask]
    """Returns which elements satisfy it, from the array, all arrays by name, and the model (None: there is none)."""
    axes: int = 0  # how many of the last axes make up an element: 1 for vectors, 2 for matrices
    used: str = ""
    """Array of the elements that count, by flags or by their number along the last axis; empty: all do. The others must
    be finite."""
    of_truth: bool = False  # whether it is truth, which a recording may not know: NaN

    def elements(self, mask: Mask) -> Mask:
        """Return of which elements a mask of numbers holds."""
        return everywhere(mask, *range(-self.axes, 0))

    def valid(self, array: Values, fields: Fields, model: Any, knows_truth: bool) -> Mask:
        """Return flags of elements that satisfy it, do not count, or are unknown."""
        valid = self.holds(array, fields, model)
        if self.used:
            used = fields[self.used]
            if used.ndim < valid.ndim:
                used = np.arange(valid.shape[-1]) < used[..., None]
            valid = valid | ((used == 0) & self.elements(np.isfinite(array)))
        if self.of_truth and not knows_truth:
            valid = valid | self.elements(np.isnan(array))
        return valid


def are_numbers(values: Values) -> Mask:
    """Return flags of finite values within the largest quantity."""
    return np.asarray(np.abs(values) <= LARGEST)


def everywhere(mask: Mask, *axes: int) -> Mask:
    """Return flags of entries at which a mask is true along all of some axes."""
    return np.asarray(mask.all(axis=axes))


def are_unit_vectors(vectors: Values, tolerance: float = MAX_BEND) -> Mask:
    """Return (...) which vectors (..., 3) have length 1."""
    with np.errstate(over="ignore", invalid="ignore"):
        return np.asarray(np.abs(np.square(vectors).sum(axis=-1) - 1.0) <= tolerance)


def are_rotations(matrices: Values, tolerance: float = MAX_BEND) -> Mask:
    """Return (...) which matrices (..., 3, 3) are rotations."""
    bounded = everywhere(np.abs(matrices) <= 2.0, -1, -2)
    R = np.where(bounded[..., None, None], matrices, 0.0)
    bend = np.abs(np.swapaxes(R, -1, -2) @ R - np.eye(3)).max(axis=(-1, -2), initial=0.0)
    first, second, third = (R[..., :, axis] for axis in range(3))
    handedness = (np.cross(first, second) * third).sum(axis=-1)
    return np.asarray(bounded & (bend <= tolerance) & (handedness > 0.0))


def are_covariances(matrices: Values, least: float) -> Mask:
    """Return (...) which matrices (..., n, n) are symmetric, not too large, and definite enough.

    `least` is the smallest eigenvalue that their correlations may have; below 0 for singular or rounded ones.
    """
    P = np.asarray(matrices, dtype=np.float64)
    bounded = everywhere(np.abs(P) <= LARGEST**2, -1, -2)
    P = np.where(bounded[..., None, None], P, 0.0)
    variances = np.diagonal(P, axis1=-2, axis2=-1)
    std = np.sqrt(np.where(variances > 0.0, variances, 1.0))
    correlation = P / (std[..., :, None] * std[..., None, :])
    skew = np.abs(correlation - np.swapaxes(correlation, -1, -2)).max(axis=(-1, -2), initial=0.0)
    return np.asarray(bounded & (skew <= MAX_ASYMMETRY) & _eigenvalues_exceed(correlation, least))


def _eigenvalues_exceed(matrices: Values, least: float) -> Mask:
    """Return (...) which symmetric matrices have no eigenvalue below one; a Cholesky factor of all is soonest made."""
    try:
        np.linalg.cholesky(matrices - least * np.eye(matrices.shape[-1]))
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.eigvalsh(matrices)[..., 0] > least)
    return np.ones(matrices.shape[:-2], dtype=bool)
