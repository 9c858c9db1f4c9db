"""A rule for the environment `pilot`; its constants were tuned by random search on a block of 64 held-out worlds."""

import numpy as np

from coopenv.policies.route_follower import RouteFollower
from coopenv.scenario import Scenario

SWEEP, PERIOD = 1.05, 5.0
"""Amplitude (rad) and period (s) of the pilot's heading about its route, by which it sees posts on both sides."""
AHEAD = 3.0
"""Distance (m) that the pilot keeps ahead of the mean place of the cars."""
ASIDE = 0.7
"""Distance (m) at which cars drive beside their routes, towards the pilot."""
CAR_SPEED, CATCH_UP, LEAST = 0.6, 0.8, 0.1
"""Speed of the cars, m/s; change of the pilot's speed per metre, 1/s; its least speed, m/s."""
WAIT = 0.6
"""Share of its speed that a car loses for each metre by which it is ahead of the other car."""
RETURN = 0.9
"""Turn (rad) towards the wanted offset per metre, for small offsets."""


class PilotRule(RouteFollower):
    """Vehicle 1 is the pilot, vehicle 2 drives in the left lane and vehicle 3 in the right lane."""

    needs = ("message_position", "message_forward", "message_mask", "route_heading", "route_offset", "role")
    remembers = 1  # decisions since the start

    def __init__(self, scenario: Scenario) -> None:
        """See `Driver`."""
        super().__init__(scenario)
        self.rate = scenario.rates.decision

    def drive(self, observations: np.ndarray) -> tuple[np.ndarray, ...]:
        """See `Driver.drive`."""
        (decisions,) = self.memory(observations)
        vehicle = np.argmax(self.read(observations, "role"), axis=1)
        pilot, side = vehicle == 0, np.choose(vehicle, (0.0, -1.0, 1.0))
        heading, offset = (self.read(observations, name)[:, 0] for name in ("route_heading", "route_offset"))
        mask, place, _ = self.reported(observations)
        ahead = place[..., 0] * np.cos(heading)[:, None] - place[..., 1] * np.sin(heading)[:, None]
        mean = np.where(mask, ahead, 0.0).sum(axis=1) / np.maximum(mask.sum(axis=1), 1)
        pace = np.clip(CAR_SPEED + CATCH_UP * (AHEAD + mean), LEAST, self.cruise)
        pace = np.where(mask.any(axis=1), pace, self.cruise)
        lead = np.where(mask[:, 1], np.maximum(-ahead[:, 1], 0.0), 0.0)  # before the other car
        speed = np.where(pilot, pace, self.cruise * np.clip(1.0 - WAIT * lead, 0.3, 1.0))
        sweep = np.where(pilot, SWEEP * np.sin(2.0 * np.pi * decisions / (PERIOD * self.rate)), 0.0)
        turn = sweep - heading - np.arctan(RETURN * (offset - ASIDE * side))
        decisions += 1
        return np.minimum(speed, self.speed(observations, self.route_points(observations)[0])), self.pursue(turn)
