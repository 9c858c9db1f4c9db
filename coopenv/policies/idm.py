"""Following the vehicle ahead by the intelligent driver model."""

import numpy as np

from coopenv.policies.route_follower import RouteFollower
from coopenv.scenario import Scenario


class IntelligentDriver(RouteFollower):
    """Pure pursuit of the way, at the speed that keeps a time gap to the nearest vehicle heard on it.

    Source: Treiber, Hennecke and Helbing, Congested traffic states in empirical observations and microscopic
    simulations, Physical Review E 62, 2000. It knows of no right of way: vehicles that cross its way count once they
    are on it.
    """

    needs = ("velocity",)

    def __init__(
        self,
        scenario: Scenario,
        *,
        cruise: float | None = None,
        look_ahead: float | None = None,
        time_gap: float = 0.8,
        standstill_gap: float = 0.3,
        acceleration: float = 1.0,
        deceleration: float = 1.5,
        half_width: float = 0.5,
    ) -> None:
        """Choose the manner of driving.

        Args:
            scenario: of the environment.
            cruise: desired speed, m/s (None: top speed).
            look_ahead: distance of the point of the way that is pursued, m (None: see `Driver`).
            time_gap: to the vehicle ahead, s.
            standstill_gap: between bumpers, m.
            acceleration: largest, m/s^2.
            deceleration: comfortable, m/s^2.
            half_width: distance from the way within which a vehicle is on it, m.
        """
        super().__init__(scenario, cruise=cruise, look_ahead=look_ahead)
        self.time_gap, self.standstill_gap, self.half_width = time_gap, standstill_gap, half_width
        self.acceleration, self.deceleration = acceleration, deceleration
        self.period = 1.0 / scenario.rates.decision
        bodies = [vehicle.body.size[0] for vehicle in scenario.vehicles if vehicle.body]
        self.length = max(bodies, default=0.0)

    def speed(self, observations: np.ndarray) -> np.ndarray:
        """Return the speeds, (rows,) in m/s, that the model's acceleration leads to until the next decision."""
        own = np.maximum(self.read(observations, "velocity")[:, 0], 0.0)
        gap, closing = np.full(len(own), np.inf), np.zeros(len(own))
        if "message_mask" in self.layout:
            gap, closing = self._ahead(observations, own)
        wanted = own * self.time_gap + own * closing / (2.0 * np.sqrt(self.acceleration * self.deceleration))
        wanted = self.standstill_gap + np.maximum(wanted, 0.0)
        free = 1.0 - (own / self.cruise) ** 4
        acceleration = self.acceleration * (free - (wanted / np.maximum(gap, 0.05)) ** 2)
        return np.asarray(np.clip(own + acceleration * self.period, 0.0, self.cruise))

    def _ahead(self, observations: np.ndarray, own: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the gap to the nearest vehicle on the way, (rows,) in m, and how fast it closes, m/s."""
        mask, place, forward = self.heard(observations)
        points, distance = self.way_ahead(observations)
        gap, closing = np.full(len(own), np.inf), np.zeros(len(own))
        for k in range(len(distance) - 1):
            leg = points[:, k + 1] - points[:, k]
            along = leg / np.maximum(np.linalg.norm(leg, axis=1, keepdims=True), 1e-9)
            offset = place - points[:, k][:, None]
            ahead = (offset * along[:, None]).sum(axis=-1)
            aside = np.abs(along[:, None, 0] * offset[..., 1] - along[:, None, 1] * offset[..., 0])
            on_it = mask & (aside < self.half_width) & (ahead > 0.0) & (ahead <= distance[k + 1] - distance[k])
            length = np.where(on_it, ahead + distance[k] - self.length, np.inf)
            which = np.argmin(length, axis=1) if length.shape[1] else np.zeros(len(own), dtype=int)
            if not length.shape[1]:
                continue
            rows = np.arange(len(own))
            nearer = length[rows, which] < gap
            theirs = self.cruise * (forward * along[:, None]).sum(axis=-1)[rows, which]
            gap = np.where(nearer, length[rows, which], gap)
            closing = np.where(nearer, own - theirs, closing)
        return gap, closing
