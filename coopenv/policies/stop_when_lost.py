"""Waiting where one does not know where one is."""

import numpy as np

from coopenv.policies.route_follower import RouteFollower
from coopenv.scenario import Scenario


class StopWhenLost(RouteFollower):
    """The route follower, but it stands still while its position is too uncertain, for a limited time.

    It waits again only after having been certain in between, so that it never stalls.
    """

    needs = ("position_std",)

    def __init__(self, scenario: Scenario, *, threshold: float = 0.15, patience: float = 3.0) -> None:
        """Choose when to stop.

        Args:
            scenario: of the environment.
            threshold: standard deviation of the position above which it stops, m.
            patience: longest time to stand, s.
        """
        super().__init__(scenario)
        self.threshold = np.log10(threshold)
        self.patience = round(patience * scenario.rates.decision)
        self._waited = np.zeros(0, dtype=int)

    def reset(self, mask: np.ndarray) -> None:
        """Begin new episodes in the rows of a mask."""
        if len(mask) != len(self._waited):
            self._waited = np.zeros(len(mask), dtype=int)
        self._waited[mask] = 0

    def speed(self, observations: np.ndarray) -> np.ndarray:
        """Return the speeds, (rows,) in m/s."""
        if len(observations) != len(self._waited):
            self.reset(np.ones(len(observations), dtype=bool))
        lost = self.read(observations, "position_std")[:, 0] > self.threshold
        self._waited = np.where(lost, self._waited + 1, 0)
        stands = lost & (self._waited <= self.patience)
        return np.where(stands, 0.0, super().speed(observations))
