"""Angles on a plane, and what linear functions of them leave out."""

import math

import numpy as np

from coopenv.estimation.arrays import Array
from coopenv.observers.planar.state import PlanarPose

NEAREST_M = 0.1  # nothing is seen from closer than this; bounds the bearing's derivatives


def wrapped(angle: float) -> float:
    """Return an angle in [-pi, pi)."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


def left_out(dx: float, dy: float, square: float, covariance: Array) -> float:
    """Return the variance of a bearing, rad^2, that its linearisation leaves out.

    That is of the second order in the covariance (2, 2) of the line's ends, m^2: where these are as uncertain as the
    line is long, a bearing says little. The line is (dx, dy) in m, `square` its length squared.
    """
    (xx, xy), (_, yy) = covariance.tolist()
    along = (dx * dx * xx + 2 * dx * dy * xy + dy * dy * yy) / square
    across = (dy * dy * xx - 2 * dx * dy * xy + dx * dx * yy) / square
    both = (dx * dy * (yy - xx) + (dx * dx - dy * dy) * xy) / square
    return float((along * across + both * both) / square**2)


def unsure(variance: float) -> tuple[float, float, float]:
    """Return what a straight path becomes under a normal error of its heading of a variance in rad^2.

    By what its mean shrinks, and the standard deviations along and across it, relative to its length, of what the best
    linear function of the heading leaves: e^(-u/2), (1 - e^-u) / sqrt 2 and sqrt((1 - e^-2u) / 2 - u e^-u).
    """
    left = -math.expm1(-variance)
    across = -math.expm1(-2 * variance) / 2 - variance * (1 - left)
    return math.exp(-variance / 2), left / math.sqrt(2), math.sqrt(max(across, 0.0))


def misfit(bearing: float, by: PlanarPose, to: PlanarPose, bearing_std: float) -> tuple[float, float]:
    """Return the normalised square of how far a bearing in rad is off between two told poses, and its variance."""
    dx, dy = (to.pose[:2] - by.pose[:2]).tolist()
    square = max(dx * dx + dy * dy, NEAREST_M**2)
    both = by.covariance[:2, :2] + to.covariance[:2, :2]
    line = np.array([dy / square, -dx / square, -1.0])
    variance = float(line @ by.covariance @ line + line[:2] @ to.covariance[:2, :2] @ line[:2])
    variance += bearing_std**2 + left_out(dx, dy, square, both)
    return wrapped(bearing - (math.atan2(dy, dx) - float(by.pose[2]))) ** 2 / variance, variance
