"""A frame's bearings as measurements of a belief."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coopenv.estimation.arrays import Array


class Sight(NamedTuple):
    """Bearings as measurements, residual = H x + noise, at the poses believed."""

    H: Array  # (m, 2, 6n)
    residual: Array  # (m, 2) rad
    ahead: NDArray[np.bool_]  # (m,) whether the target is in front of the bearing at all
    distance: Array  # (m,) m
    bend: Array  # (m,) rad^2, the variance of what is not linear in x

    def normalised(self, P: Array, noise: Array) -> Array:
        """Return (m,) the normalised innovations squared under P and noise variances (m,)."""
        H = self.H
        S = H.reshape(-1, len(P)).dot(P).reshape(H.shape) @ H.transpose(0, 2, 1)
        a, b, c = S[:, 0, 0] + noise, S[:, 0, 1], S[:, 1, 1] + noise
        x, y = self.residual[:, 0], self.residual[:, 1]
        result: Array = (c * x * x - 2.0 * b * x * y + a * y * y) / (a * c - b * b)
        return result


class View(NamedTuple):
    """A frame's bearings to known targets."""

    sight: Sight
    noise: Array  # (m,) variances
    nis: Array  # (m,) normalised innovations squared
    fits: NDArray[np.bool_]  # (m,) whether they fit the belief
    missed: float | None
    """Share of those that do not, without bearings to distrusted senders; None if there is no bearing."""
