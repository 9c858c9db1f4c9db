"""A driver that lets the car behind keep up."""

import numpy as np

from coopenv.policies.route_follower import RouteFollower
from coopenv.scenario import Scenario


class KeepContact(RouteFollower):
    """The route follower, which slows down where the next car behind falls back towards the reach of its sensors.

    Sensors between vehicles then keep measuring, from the first car to the last. Up to half of the reach it drives at
    full speed, beyond it ever slower.
    """

    needs = ("message_position",)
    slowest = 0.5  # of the top speed, so that a car behind that never moves again does not hold it for ever

    def __init__(self, scenario: Scenario) -> None:
        """See `Driver`."""
        super().__init__(scenario)
        others = range(len(scenario.landmarks), len(scenario.target_names))
        sensors = [s for s in scenario.sensors if any(s.measures(scenario, other) for other in others)]
        ranges = [sensor.range for sensor in sensors] + [camera.range for camera in scenario.cameras]
        self.reach = min((reach for reach in ranges if reach is not None), default=np.inf)
        """Shortest range of any sensor of vehicles, m."""

    def speed(self, observations: np.ndarray, points: np.ndarray | None = None) -> np.ndarray:
        """See `RouteFollower.speed`."""
        mask, place, _ = self.reported(observations)
        behind = mask & (place[..., 0] < 0.0)
        gap = np.min(np.linalg.norm(place, axis=-1), axis=1, where=behind, initial=np.inf)
        gap = np.where(behind.any(axis=1), gap, 0.0)  # without a car behind nothing is to keep
        share = np.clip(2.0 * (1.0 - gap / self.reach), self.slowest, 1.0)
        return np.asarray(share * super().speed(observations, points))
