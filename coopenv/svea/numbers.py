"""Numbers of messages: finite, and no larger than what they measure can be."""

from typing import Any

import numpy as np

from coopenv.errors import CoopenvError, shown
from coopenv.svea.samples import Array


def vector(value: Any, field: str, most: float) -> Array:
    """Return x, y, z as (3,), none of them larger than `most`."""
    return numbers_of((value.x, value.y, value.z), field, most)


def numbers_of(values: Any, field: str, most: float) -> Array:
    """Return numbers as an array. Raises CoopenvError: one is not finite, or larger than `most`."""
    numbers = np.array(values, dtype=np.float64)
    if not (np.abs(numbers) <= most).all():
        raise CoopenvError(f"{field}: {shown(numbers.tolist())} is not finite, or beyond {most:g}")
    return numbers


def covariance_of(values: Any, field: str) -> Array:
    """Return (6, 6) numbers whose diagonal is not negative and that are symmetric."""
    matrix = numbers_of(values, field, 1e12).reshape(6, 6)
    if not matrix.any():  # often: not known
        return matrix
    if (matrix.diagonal() < 0.0).any() or (np.abs(matrix - matrix.T) > 1e-9 + 1e-6 * np.abs(matrix.T)).any():
        raise CoopenvError(f"{field}: is no covariance (symmetric, no negative variance)")
    return matrix
