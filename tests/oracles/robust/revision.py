"""Whether it is others who lie than those that a vehicle does not believe: all bearings from where landmarks put it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from coopenv.estimation.arrays import Array
from coopenv.observers.robust.constants import BEND_TIME, MAX_BEARING_COST
from tests.oracles.robust.belief import Belief
from tests.oracles.robust.sight import Sight
from tests.oracles.robust.tracklets import left_error


class Told(NamedTuple):
    """Where a sender says to be, and the bearing to it."""

    vehicle: int
    bearing: Array  # (3,) body frame
    point: Array  # (3,) m, map frame
    variance: float  # m^2 per axis
    rejected: bool


class Explanation(NamedTuple):
    """What it costs not to believe some senders, and where the vehicle is then."""

    cost: float
    R: Array
    p: Array


def explained(alone: Belief, words: Sequence[Told], lever_arm: Array, variance: float) -> Explanation:
    """Return what an estimate and the words that are not rejected cost together, and where they agree."""
    own = alone.own
    belief = Belief(own.vehicle, own.R, own.p, alone.P[:6, :6].copy())
    counted = [word for word in words if not word.rejected]
    cost = MAX_BEARING_COST * (len(words) - len(counted))

    def look() -> tuple[Sight, Array]:
        b, z = np.array([word.bearing for word in counted]), np.array([word.point for word in counted])
        sight = belief.sight(b, lever_arm, z, period=BEND_TIME)
        return sight, variance + np.array([word.variance for word in counted]) / sight.distance**2 + sight.bend

    if counted:
        sight, noise = look()
        if not sight.ahead.all():
            return Explanation(np.inf, own.R, own.p)
        belief.settle(sight, noise, np.ones(len(counted), bool), look)
        sight, noise = look()
        if not sight.ahead.all():
            return Explanation(np.inf, own.R, own.p)
        cost += float(((sight.residual**2).sum(axis=1) / noise).sum())
    return Explanation(cost + separation(alone, belief.own.R, belief.own.p), belief.own.R, belief.own.p)


def separation(belief: Belief, R: Array, p: Array) -> float:
    """Return how far a pose is from a belief, squared in standard deviations of that."""
    e = left_error(belief.own.R, belief.own.p, R, p)
    return float(e.dot(np.linalg.solve(belief.P[:6, :6], e)))
