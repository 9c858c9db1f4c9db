"""Absolute and relative trajectory error, as the tool evo defines them (APE and RPE), in NumPy.

Source: Sturm, Engelhard, Endres, Burgard and Cremers, A benchmark for the evaluation of RGB-D SLAM systems, IROS 2012.
Maps here are global, so nothing is aligned: an alignment would hide the mirrored solution.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coopenv.estimation.arrays import Array
from coopenv.estimation.metrics import orientation_error_deg


class RelativeError(NamedTuple):
    """Root mean squares over pairs of poses; NaN where there is no pair."""

    position: float  # m
    orientation: float  # deg


def absolute_error(position: Array, position_estimate: Array) -> float:
    """Return ATE: the root mean square of |p - phat| in m, of positions (K, 3), over the ticks whose truth is known."""
    known = np.isfinite(position).all(axis=-1)
    if not known.any():
        return float("nan")
    difference = position[known] - position_estimate[known]
    return float(np.sqrt(np.mean(np.sum(difference**2, axis=-1))))


def relative_error(
    rotation: Array, position: Array, rotation_estimate: Array, position_estimate: Array, delta: int
) -> RelativeError:
    """Return RPE: the root mean square over pairs (k, k + delta) of E = (P_k^-1 P_k+)^-1 (Phat_k^-1 Phat_k+).

    Rotations (K, 3, 3) are body to map, positions (K, 3) in the map, m; pairs whose truth is NaN are left out, and they
    do not overlap: k = 0, delta, 2 delta, ... Relative errors of different deltas, in ticks, cannot be compared.
    """
    start = np.arange(0, max(len(position) - delta, 0), delta)
    known: NDArray[np.bool_] = np.isfinite(np.concatenate([rotation, position[..., None]], axis=-1)).all(axis=(-1, -2))
    start = start[known[start] & known[start + delta]]
    if not len(start):
        return RelativeError(float("nan"), float("nan"))
    R, p = _moved(rotation, position, start, start + delta)
    R_hat, p_hat = _moved(rotation_estimate, position_estimate, start, start + delta)
    # E = (R^T R_hat, R^T (p_hat - p)), and the rotation keeps the length
    distance, angle = np.linalg.norm(p_hat - p, axis=-1), orientation_error_deg(R, R_hat)
    return RelativeError(float(np.sqrt(np.mean(distance**2))), float(np.sqrt(np.mean(angle**2))))


def _moved(R: Array, p: Array, begin: NDArray[np.int64], end: NDArray[np.int64]) -> tuple[Array, Array]:
    """Return P_begin^-1 P_end as rotations (n, 3, 3) and positions (n, 3)."""
    back = np.swapaxes(R[begin], -1, -2)
    return back @ R[end], (back @ (p[end] - p[begin])[..., None])[..., 0]
