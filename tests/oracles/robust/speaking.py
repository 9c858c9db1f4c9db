"""What a vehicle says: its pose, and at times how its error correlates with those of others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from coopenv.estimation.arrays import Array
from coopenv.observers.contract import Message, Setup
from coopenv.observers.robust.constants import MAX_CORRELATIONS, NEWS_TIME, SAME_TIME, STEPS
from tests.oracles.robust.common import Common
from tests.oracles.robust.told import factor
from tests.oracles.robust.tracklets import marker_jacobian


class Speaking(Common):
    """The messages of `robust`."""

    def __init__(self, setup: Setup) -> None:
        """Start without having said anything."""
        super().__init__(setup)
        self.interval = -1

    def message(self) -> Message:
        """Return pose, covariance, odometry and the correlations with members."""
        message = super().message()
        if message.position is None:
            return message
        extra = {"odometry": message.extra["odometry"].astype(np.float32)}
        interval = int(np.floor((self.belief.own.time + SAME_TIME) / NEWS_TIME))
        if interval != self.interval:
            self.interval = interval
            extra |= self._correlations()
        return replace(message, extra={**message.extra, **extra})

    def _correlations(self) -> dict[str, Array]:
        """Return the correlations with some members, as they travel."""
        P, J = self.belief.P, marker_jacobian(self.marker)
        A = factor(J.dot(P[:6, :6]).dot(J.T))
        told = self._told_of()
        correlations = np.zeros((len(told), 6, 6), np.int8)
        for k, n in enumerate(told):
            block = slice(6 * n, 6 * n + 6)
            C = np.linalg.solve(A, np.linalg.solve(factor(P[block, block]), J.dot(P[:6, block]).T).T)
            correlations[k] = np.clip(np.rint(STEPS * C), -STEPS, STEPS)
        members = [self.belief.members[n] for n in told]
        return {
            "told": np.array([member.vehicle for member in members], np.uint16),
            "ages": np.array([self.belief.own.time - member.time for member in members], np.float32),
            "correlations": correlations,
        }

    def _told_of(self) -> list[int]:
        """Return which members are told of: those that depend on most others, to whom there are most ways."""
        members = [n for n, m in enumerate(self.belief.members) if n and m.considered]

        def order(n: int) -> tuple[int, int]:
            vehicle = self.belief.members[n].vehicle
            return self.contacts[vehicle].last.depends_on.bit_count(), vehicle

        return sorted(members, key=order, reverse=True)[:MAX_CORRELATIONS]
