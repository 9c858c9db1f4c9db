"""Whether an estimate's covariance is honest, and intervals for what was counted over runs.

Source: Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, 5.4 (NEES and NIS
with chi-square bounds); Wilson, Probable inference, JASA 22, 1927 (interval of a share).
"""

import math
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2, norm

from coopenv.estimation.arrays import Array
from coopenv.estimation.coordinates import Coordinates
from coopenv.estimation.rotations import skew

LEVEL = 0.95
DIVERGED_POSITION, DIVERGED_ORIENTATION = 5.0, 30.0  # m and deg: a run that ends above either has diverged


class Interval(NamedTuple):
    """Low and high end."""

    low: float
    high: float


def mean_bounds(dof: int, runs: int = 1, level: float = LEVEL) -> Interval:
    """Return where the mean over independent runs of a chi-square of `dof` degrees, divided by `dof`, lies.

    For ANEES the runs are Monte Carlo runs at one instant: ticks of one run are correlated, so the bounds do not hold
    for a mean over time. For NIS, which is white over time, a run may be a tick. `level` is the probability of lying
    inside.
    """
    total, tail = dof * runs, (1.0 - level) / 2.0
    return Interval(float(chi2.ppf(tail, total)) / total, float(chi2.ppf(1.0 - tail, total)) / total)


def wilson_interval(successes: int, trials: int, level: float = LEVEL) -> Interval:
    """Return the interval of a probability of which `successes` in `trials` were seen; all of [0, 1] without trials."""
    if trials == 0:
        return Interval(0.0, 1.0)
    z, share = float(norm.ppf((1.0 + level) / 2.0)), successes / trials
    centre = share + z**2 / (2 * trials)
    spread = z * math.sqrt(share * (1.0 - share) / trials + z**2 / (4 * trials**2))
    scale = 1.0 + z**2 / trials
    return Interval(max(0.0, (centre - spread) / scale), min(1.0, (centre + spread) / scale))


def diverged(position_error: Array, orientation_error: Array) -> np.ndarray:
    """Return whether runs that end with these errors (m, deg) have diverged; NaN, of a failed one, has."""
    return ~((position_error <= DIVERGED_POSITION) & (orientation_error <= DIVERGED_ORIENTATION))


def position_std(covariance: Array, coordinates: Coordinates, rotation: Array, position: Array) -> Array:
    """Return sqrt(trace) (...) of the covariance of the position in the map that P (..., 6, 6) states, m.

    To first order pbar - pbarhat is, up to a rotation, rho in LEFT coordinates, rho - S(pbarhat) theta in RIGHT ones,
    and dp - S(phat) theta in the paper's, whose phat is in the body frame. The estimate's position is in the map, m.
    """
    if coordinates is Coordinates.LEFT:
        variance = np.trace(covariance[..., 3:, 3:], axis1=-2, axis2=-1)
    else:
        if coordinates is Coordinates.RICCATI:
            position = (np.swapaxes(rotation, -1, -2) @ position[..., None])[..., 0]
        J = np.concatenate([-skew(position), np.broadcast_to(np.eye(3), (*position.shape, 3))], axis=-1)
        variance = np.einsum("...ij,...jk,...ik->...", J, covariance, J)
    return np.sqrt(np.where(variance >= 0.0, variance, np.nan))  # not every P that is stated is a covariance
