"""A rule for the environment `two_pilots`; its constants were tuned by random search on a block of held-out worlds."""

import numpy as np

from coopenv.policies.route_follower import RouteFollower
from coopenv.scenario import Scenario

CENTER, SWEEP, PERIOD, PHASE = 0.11, 1.06, 4.04, 3.13
"""Mean (rad, towards a pilot's posts), amplitude (rad), period (s) of a pilot's heading; phase (rad) of the second."""
AHEAD, APART = 3.2, 0.63
"""Distances (m) that pilots keep ahead of the cars: on average, and half of the difference of the two pilots."""
SCOUTING, SCOUT_SPEED = 1.21, 0.25
"""Time (s) from the start in which pilots drive at a fixed speed (m/s), so that they can turn to posts."""
OWN = 1.66
"""Additional weight of the car on a pilot's own side in the mean place of the cars."""
ASIDE, CLOSER = 0.72, 0.11
"""Distances at which vehicles drive beside their routes, m: cars towards the pilots, pilots towards their posts."""
CAR_SPEED, CATCH_UP, LEAST = 0.6, 0.65, 0.39
"""Speed of the cars, m/s; change of a pilot's speed per metre, 1/s; its least speed, m/s."""
WAIT = 0.11
"""Share of its speed that a car loses for each metre by which it is ahead of the other car."""
RETURN = 1.11
"""Turn (rad) towards the wanted offset per metre, for small offsets."""


class TwoPilotsRule(RouteFollower):
    """Vehicles 1 and 2 are pilots; vehicles 1 and 3 drive on the left, the others on the right."""

    needs = ("message_position", "message_forward", "message_mask", "route_heading", "route_offset", "role")
    remembers = 1  # decisions since the start

    def __init__(self, scenario: Scenario) -> None:
        """See `Driver`."""
        super().__init__(scenario)
        self.rate = scenario.rates.decision

    def drive(self, observations: np.ndarray) -> tuple[np.ndarray, ...]:
        """See `Driver.drive`."""
        (decisions,) = self.memory(observations)
        vehicle, time = np.argmax(self.read(observations, "role"), axis=1), decisions / self.rate
        pilot, side = vehicle < 2, np.where(vehicle % 2, -1.0, 1.0)
        heading, offset = (self.read(observations, name)[:, 0] for name in ("route_heading", "route_offset"))
        mask, place, _ = self.reported(observations)
        ahead = place[..., 0] * np.cos(heading)[:, None] - place[..., 1] * np.sin(heading)[:, None]
        weight = np.stack([0.0 * side, 1.0 + OWN * (vehicle == 0), 1.0 + OWN * (vehicle == 1)], axis=1) * mask
        mean = (weight * ahead).sum(axis=1) / np.maximum(weight.sum(axis=1), 1.0)
        pace = np.clip(CAR_SPEED + CATCH_UP * (AHEAD + APART * side + mean), LEAST, self.cruise)
        pace = np.where(mask[:, 1:].any(axis=1), pace, self.cruise)
        pace = np.where(time < SCOUTING, SCOUT_SPEED, pace)
        lead = np.where(mask[:, 2], np.maximum(-ahead[:, 2], 0.0), 0.0)  # before the other car
        speed = np.where(pilot, pace, self.cruise * np.clip(1.0 - WAIT * lead, 0.3, 1.0))
        sweep = CENTER + SWEEP * np.sin(2.0 * np.pi * time / PERIOD + PHASE * (vehicle == 1))
        turn = np.where(pilot, side * sweep, 0.0) - heading
        turn -= np.arctan(RETURN * (offset - side * np.where(pilot, CLOSER, -ASIDE)))
        decisions += 1
        return np.minimum(speed, self.speed(observations, self.route_points(observations)[0])), self.pursue(turn)
