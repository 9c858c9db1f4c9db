"""Numbers that stand for faults, and what is believed after a restart; known to programs without the kernels."""

import math

import numpy as np

HONEST, JUMP, DRIFT, REPLAY, COLLUDE = range(5)
"""Values of `Model.fault.lie`."""

KINDS = {"none": HONEST, "jump": JUMP, "drift": DRIFT, "replay": REPLAY, "collude": COLLUDE}
UNIFORM_ROTATION = (math.pi**2 / 3.0 + 2.0) / 3.0
"""rad^2 per axis, of a rotation uniform over SO(3)."""
UNKNOWN_POSITION = 100.0
"""m per axis, standard deviation of where a vehicle is that has lost all, about the landmarks' centre."""
UNKNOWN = np.diag(np.repeat([UNIFORM_ROTATION, UNKNOWN_POSITION**2], 3))
"""Covariance of the initial estimate of a vehicle that has started anew, LEFT coordinates."""
