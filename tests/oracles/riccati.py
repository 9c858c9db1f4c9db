"""The paper's Riccati observer in NumPy, for one vehicle: the splitting oracle as a plug-in."""

from __future__ import annotations

import numpy as np

from coopenv.estimation.poses import Array, Coordinates
from coopenv.observers.contract import Estimate, Message, Setup, Tick

from . import splitting


class Riccati:
    """The paper's observer, with the scenario's gains."""

    def __init__(self, setup: Setup) -> None:
        """Take the gains of this vehicle."""
        self.gains, self.marker = setup.gains, setup.marker

    def reset(self, initial_pose: tuple[Array, Array], initial_covariance: Array) -> None:
        """Start at a pose with the scenario's P(0); the given covariance is not used, P being none."""
        self.state = splitting.initial_estimate(*initial_pose, np.diag(np.repeat(self.gains.P0, 3)))
        self.since = 0.0

    def update(self, tick: Tick) -> Estimate:
        """Predict by the odometry, then let the bearings act for the time since the last correction."""
        x, F = self.state, np.kron(np.eye(2), tick.rotation.T)
        P = F @ x.P @ F.T + np.diag(np.repeat(self.gains.V, 3)) * tick.dt
        x = splitting.Estimate(x.R @ tick.rotation, tick.rotation.T @ (x.p + tick.translation), P)
        self.since += tick.dt
        if tick.due:
            seen = tick.usable()
            bearings, positions = [s[1] for s in seen], [s[2] for s in seen]
            q, k, most = self.gains.q[np.array([s[0] for s in seen], int)], self.gains.k, self.gains.max_turn
            x = splitting.correct(x, bearings, positions, q, k, self.since, tick.lever_arm, most)
            self.since = 0.0
        self.state = x
        return Estimate(x.R, x.position, (x.P + x.P.T) / 2, Coordinates.RICCATI)

    def message(self) -> Message:
        """Return the marker's position."""
        return Message(position=self.state.R @ (self.state.p + self.marker))
