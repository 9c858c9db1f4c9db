"""Error-state filter that fuses neighbours by split covariance intersection.

Source: Julier and Uhlmann, A non-divergent estimation algorithm in the presence of unknown correlations, 1997. For a
bearing to a neighbour P becomes P / w, and the neighbour's part of the noise H_j P_j H_j^T / (1 - w): the two may be
correlated in any way. The bearing's own noise is independent and stays whole. w minimises det P+. Consistent, at the
price of information.
"""

from __future__ import annotations

import numpy as np

from coopenv.estimation.observers.base import Array, Message, Tick
from coopenv.estimation.observers.mekf import Mekf, innovation, kalman

WEIGHTS = np.concatenate([np.linspace(0.02, 0.98, 49), 1.0 - np.logspace(-2.0, -6.0, 25)])
"""Candidates for w; w = 1 leaves the measurement out."""


class CovarianceIntersection(Mekf):
    """Landmarks by a Kalman update, then neighbours one at a time by covariance intersection."""

    sends_covariance = True

    def correct(self, tick: Tick, b: Array, z: Array, messages: list[Message | None]) -> None:
        """Correct by bearings b (m, 3) to positions z (m, 3)."""
        known = np.array([m is None or m.covariance is None for m in messages])
        if known.any():
            super().correct(tick, b[known], z[known], [None] * int(known.sum()))
        for n in np.flatnonzero(~known):
            message = messages[n]
            if message is not None and message.covariance is not None:
                self.intersect(tick, b[n : n + 1], z[n : n + 1], message.covariance)

    def intersect(self, tick: Tick, b: Array, z: Array, covariance: Array) -> None:
        """Fuse one bearing to a neighbour with the covariance (3, 3) of its position."""
        residual, J = innovation(self.state.R, self.state.p, tick.lever_arm, b, z)
        H = (J @ self.state.jacobian(z))[0]
        G = J[0] @ self.state.R.T
        own, theirs, prior = (
            tick.noise.bearing_std**2 * np.eye(2),
            G @ covariance @ G.T,
            H @ self.state.P @ H.T,
        )
        w = best_weight(prior, own, theirs)
        if w < 1.0:
            self.state = self.state.moved(*kalman(self.state.P / w, H, own + theirs / (1.0 - w), residual[0]))


def best_weight(prior: Array, own: Array, theirs: Array) -> float:
    """Return the w in (0, 1] that minimises det P+ over the candidates.

    With N = own + theirs / (1 - w), by the determinant lemma
    log det P+ - log det P = -6 log w + log det N - log det(N + H P H^T / w), which is 0 at w = 1.
    """
    w = WEIGHTS[:, None, None]
    N = own + theirs / (1.0 - w)
    cost = -6.0 * np.log(WEIGHTS) + np.log(np.linalg.det(N)) - np.log(np.linalg.det(N + prior / w))
    best = int(np.argmin(cost))
    return float(WEIGHTS[best]) if cost[best] < 0.0 else 1.0
