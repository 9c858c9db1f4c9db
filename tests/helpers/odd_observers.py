"""Observers that comparisons send to other processes, which import this file and no test."""

from __future__ import annotations

from coopenv.observers.contract import Estimate, Tick
from coopenv.observers.pose_filters import DeadReckoning


class Raises(DeadReckoning):
    """Fails at its first update."""

    def update(self, tick: Tick) -> Estimate:
        raise ZeroDivisionError("by design")


class Tells(DeadReckoning):
    """Tells an innovation of 3 in 2 degrees of freedom."""

    def update(self, tick: Tick) -> Estimate:
        found = super().update(tick)
        return Estimate(found.rotation, found.position, found.covariance, found.coordinates, 3.0, 2)
