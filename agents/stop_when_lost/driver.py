"""A driver that waits while it is lost."""

import numpy as np

from coopenv.policies.route_follower import RouteFollower
from coopenv.scenario import Scenario


class StopWhenLost(RouteFollower):
    """The route follower, but it stands still while its position is too uncertain, for a limited time.

    It waits again only after having been certain in between, so that it never stalls.
    """

    needs = ("position_std",)
    remembers = 1  # decisions for which it has been lost
    threshold = 0.15  # m, standard deviation of the position above which it stops
    patience = 3.0  # s, longest time to stand

    def __init__(self, scenario: Scenario) -> None:
        """See `Driver`."""
        super().__init__(scenario)
        self.longest = round(self.patience * scenario.rates.decision)  # decisions

    def speed(self, observations: np.ndarray, points: np.ndarray | None = None) -> np.ndarray:
        """See `RouteFollower.speed`."""
        lost = self.read(observations, "position_std")[:, 0] > np.log10(self.threshold)
        (waited,) = self.memory(observations)
        waited[:] = np.where(lost, waited + 1, 0)
        stands = lost & (waited <= self.longest)
        return np.where(stands, 0.0, super().speed(observations, points))
