"""Equations and measures of estimators; here the codes that kernels and host share: sight, outcome, lies of senders."""

import math
from enum import IntEnum

import numpy as np


class Sight(IntEnum):
    """Why a target is or is not measured by a camera at one tick."""

    NOT_A_NEIGHBOUR = 0
    VISIBLE = 1
    OUT_OF_VIEW = 2
    OCCLUDED_BY_BUILDING = 3
    OCCLUDED_BY_BODY = 4
    MISSED = 5


class Outcome(IntEnum):
    """Outcome of a vehicle's episode so far."""

    UNDER_WAY = 0
    ARRIVED = 1
    COLLIDED = 2
    OFF_ROUTE = 3

    @property
    def words(self) -> str:
        """The name in small letters: "under way", "arrived", "collided", "off route"."""
        return self.name.lower().replace("_", " ")


HONEST, JUMP, DRIFT, REPLAY, COLLUDE = range(5)
"""Values of `Model.fault.lie`."""

KINDS = {"none": HONEST, "jump": JUMP, "drift": DRIFT, "replay": REPLAY, "collude": COLLUDE}
UNIFORM_ROTATION = (math.pi**2 / 3.0 + 2.0) / 3.0
"""rad^2 per axis, of a rotation uniform over SO(3)."""
UNKNOWN_POSITION = 100.0
"""Standard deviation (m per axis) of a lost vehicle's position about the landmarks' centre."""
UNKNOWN = np.diag(np.repeat([UNIFORM_ROTATION, UNKNOWN_POSITION**2], 3))
"""Covariance of the initial estimate of a vehicle that has started anew, LEFT coordinates."""
