"""A driver that keeps a time gap to the vehicle ahead."""

import numpy as np

from coopenv.policies.route_follower import RouteFollower
from coopenv.scenario import Scenario


class IntelligentDriver(RouteFollower):
    """Pure pursuit of the route, at the speed that keeps a time gap to the nearest sender on it.

    Source: Treiber, Hennecke and Helbing, Congested traffic states in empirical observations and microscopic
    simulations, Physical Review E 62, 2000. It has no rules of priority: vehicles that cross its route count once they
    are on it.
    """

    needs = ("velocity",)
    time_gap = 0.8  # s, to the vehicle ahead
    standstill_gap = 0.3  # m, between bumpers
    acceleration = 1.0  # m/s^2, largest
    deceleration = 1.5  # m/s^2, comfortable
    half_width = 0.5  # m, distance from the route within which a vehicle is on it

    def __init__(self, scenario: Scenario, *, cruise: float | None = None) -> None:
        """See `Driver`."""
        super().__init__(scenario, cruise=cruise)
        bodies = [vehicle.body.size[0] for vehicle in scenario.vehicles if vehicle.body]
        self.length = max(bodies, default=0.0)

    def speed(self, observations: np.ndarray, points: np.ndarray | None = None) -> np.ndarray:
        """Return the speeds, (rows,) in m/s, that the model's acceleration leads to until the next decision."""
        own = np.maximum(self.read(observations, "velocity")[:, 0], 0.0)
        gap, closing = self._ahead(observations, own)
        wanted = own * self.time_gap + own * closing / (2.0 * np.sqrt(self.acceleration * self.deceleration))
        wanted = self.standstill_gap + np.maximum(wanted, 0.0)
        free = 1.0 - (own / self.cruise) ** 4
        acceleration = self.acceleration * (free - (wanted / np.maximum(gap, 0.05)) ** 2)
        return np.asarray(np.clip(own + acceleration * self.period, 0.0, self.cruise))

    def _ahead(self, observations: np.ndarray, own: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the gap to the nearest vehicle on the route, (rows,) in m, and how fast it closes, m/s."""
        mask, place, forward = self.received(observations)
        points, distance = self.route_points(observations)
        leg = np.diff(points, axis=1)
        along = leg / np.maximum(np.linalg.norm(leg, axis=2, keepdims=True), 1e-9)
        offset = place[:, None] - points[:, :-1, None]
        ahead = (offset * along[:, :, None]).sum(axis=-1)
        aside = np.abs(along[..., :1] * offset[..., 1] - along[..., 1:] * offset[..., 0])
        on_it = mask[:, None] & (aside < self.half_width) & (ahead > 0.0) & (ahead <= np.diff(distance)[:, None])
        gaps = np.where(on_it, ahead + distance[:-1, None] - self.length, np.inf)
        theirs = self.cruise * (forward[:, None] * along[:, :, None]).sum(axis=-1)
        first = np.argmin(gaps.reshape(len(own), -1), axis=1)
        gap, speed = (part.reshape(len(own), -1)[np.arange(len(own)), first] for part in (gaps, theirs))
        return gap, np.where(np.isfinite(gap), own - speed, 0.0)
