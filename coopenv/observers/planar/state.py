"""What the planar filter estimates, by place in its state, and what of it is told."""

from typing import NamedTuple

import numpy as np

from coopenv.estimation.arrays import Array

X, Y, HEADING, TURN_SCALE, SPEED_SCALE, TURN_OFFSET, SPEED_OFFSET, SLOWDOWN, LEAD, BIAS, SHARE, DRIFT = range(12)
STATES = 12


class PlanarPose(NamedTuple):
    """What a robot tells another: x m, y m, heading rad (3,), and their covariance (3, 3)."""

    pose: Array
    covariance: Array


def picked(state: Array, covariance: Array) -> PlanarPose:
    """Return x, y and the heading from which bearings count (the camera's bias taken off), with their covariance."""
    pick = np.eye(3, STATES)
    pick[HEADING, BIAS] = -1.0
    return PlanarPose(pick @ state, pick @ covariance @ pick.T)
