"""A rule for the environment `relay`; its constants were tuned by random search on a block of held-out worlds."""

import numpy as np

from coopenv.policies.route_follower import RouteFollower
from coopenv.scenario import Scenario

CENTER, SWEEP, PERIOD = (0.4, 0.08), (0.82, 1.4), (6.0, 5.74)
"""Mean (rad, to the left), amplitude (rad) and period (s) of the heading of either scout while it moves."""
SHIFT = (-0.6, -0.25)
"""Distances at which scouts drive to the left of their routes, m."""
AHEAD, LEAST = (3.75, 3.75), (0.2, 0.0)
"""Distances (m) that scouts keep ahead of the cars, and their least speeds, m/s."""
SCOUTING, SCOUT_SPEED = (0.0, 0.86), 0.22
"""Times (s) from the start in which scouts drive at a fixed speed (m/s), so that they can turn to posts."""
CAR_SPEED, CATCH_UP, REAR = 0.6, 0.2, 0.53
"""Speed of the cars, m/s; change of a scout's speed per metre, 1/s; weight of the rear car against the mean of both."""
ASIDE, FACING, WAIT = 0.53, 0.33, 0.1
"""Distance at which cars drive beside their routes, towards the scouts, m; share of their turn that faces the next
scout; share of its speed that a car loses for each metre by which it is ahead of the other car."""
RETURN = 0.91
"""Turn (rad) towards the wanted offset per metre, for small offsets."""
PASSED = 0.5
"""Distance ahead, m, below which a scout is no longer faced."""
STANDING = 0.05
"""Speed below which a scout's sweep rests, m/s."""


class RelayRule(RouteFollower):
    """Vehicles 1 and 2 are scouts of the first and second half; vehicle 3 drives on the left, 4 on the right."""

    needs = ("message_position", "message_forward", "message_mask", "route_heading", "route_offset", "role")
    remembers = 2  # decisions since the start, and decisions in motion

    def __init__(self, scenario: Scenario) -> None:
        """See `Driver`."""
        super().__init__(scenario)
        self.rate = scenario.rates.decision

    def drive(self, observations: np.ndarray) -> tuple[np.ndarray, ...]:
        """See `Driver.drive`."""
        decisions, moving = self.memory(observations)
        vehicle = np.argmax(self.read(observations, "role"), axis=1)
        heading, offset = (self.read(observations, name)[:, 0] for name in ("route_heading", "route_offset"))
        mask, place, _ = self.reported(observations)
        ahead = place[..., 0] * np.cos(heading)[:, None] - place[..., 1] * np.sin(heading)[:, None]
        scout, second, left = vehicle < 2, (vehicle > 0).astype(int), np.where(vehicle == 2, 1.0, -1.0)
        pace = self.pace(mask[:, 1:], ahead[:, 1:], second)
        pace = np.where(decisions / self.rate < np.take(SCOUTING, second), SCOUT_SPEED, pace)
        lead = np.where(mask[:, 2], np.maximum(-ahead[:, 2], 0.0), 0.0)  # before the other car
        speed = np.where(scout, pace, self.cruise * np.clip(1.0 - WAIT * lead, 0.3, 1.0))
        phase = 2.0 * np.pi * moving / self.rate / np.take(PERIOD, second)
        sweep = np.take(CENTER, second) + np.take(SWEEP, second) * np.sin(phase)
        wanted = np.where(scout, np.take(SHIFT, second), -ASIDE * left)
        turn = np.where(scout, sweep, 0.0) - heading - np.arctan(RETURN * (offset - wanted))
        facing = (1.0 - FACING) * turn + FACING * self.bearing(mask[:, :2], ahead[:, :2], place[:, :2])
        decisions += 1
        moving += speed > STANDING
        speed = np.minimum(speed, self.speed(observations, self.route_points(observations)[0]))
        return speed, self.pursue(np.where(scout, turn, facing))

    def pace(self, received: np.ndarray, ahead: np.ndarray, second: np.ndarray) -> np.ndarray:
        """Return the speeds of scouts, (rows,) in m/s, from the distances (rows, 2), m, at which cars are ahead."""
        mean = np.where(received, ahead, 0.0).sum(axis=1) / np.maximum(received.sum(axis=1), 1)
        rear = np.min(ahead, axis=1, where=received, initial=np.inf)
        any_car = received.any(axis=1)
        place = mean + REAR * (np.where(any_car, rear, 0.0) - mean)
        pace = CAR_SPEED + CATCH_UP * (np.take(AHEAD, second) + place)
        return np.where(any_car, np.clip(pace, np.take(LEAST, second), self.cruise), self.cruise)

    def bearing(self, received: np.ndarray, ahead: np.ndarray, place: np.ndarray) -> np.ndarray:
        """Return the direction, (rows,) in rad, of the nearest scout ahead, of (rows, 2); 0 without one."""
        distance = np.where(received & (ahead > PASSED), ahead, np.inf)
        x, y = place[np.arange(len(place)), distance.argmin(axis=1)].T
        return np.where(np.isfinite(distance).any(axis=1), np.arctan2(y, x), 0.0)
