"""The baseline: along the way at full speed, giving way to the vehicles that it hears."""

import numpy as np

from coopenv.policies.driver import Driver
from coopenv.scenario import Scenario

GAP = 0.25
"""m, between bodies."""

SOON = 1.0
"""s; cars that stop within this drive at full speed or stand; others are on the way between the two for long."""

REACTION = 0.5
"""s; cars that stop slowly look ahead for as long as stopping takes and this: their guesses are good for no longer."""


class RouteFollower(Driver):
    """Pure pursuit of the way by the vehicle's own estimate; stops where driving on would come too close to others.

    In the leader-follower order a vehicle hears its leaders only, so giving way to whomever one hears cannot deadlock.
    """

    def __init__(
        self,
        scenario: Scenario,
        *,
        cruise: float | None = None,
        look_ahead: float | None = None,
        clearance: float = 0.9,
        closest: float = 0.75,
        foresight: float | None = None,
    ) -> None:
        """Choose the manner of driving.

        Args:
            scenario: of the environment.
            cruise: speed when nothing is in the way, m/s; also what others are expected to drive (None: top speed).
            look_ahead: distance of the point of the way that is pursued, m (None: see `Driver`).
            clearance: distance to keep between reference points, m, where it does not know how sure it is of its own.
            closest: distance to keep where it is sure, m; its standard deviation is added, up to `clearance`.
                Both are at least what keeps cars `GAP` apart of which one stands across the other's way.
            foresight: how far ahead to look for others, s (None: 6 s, or less where cars stop slowly, see `REACTION`).
        """
        super().__init__(scenario, cruise=cruise, look_ahead=look_ahead)
        least = (self.length + self.width) / 2.0 + GAP
        self.clearance, self.closest = max(clearance, least), max(closest, least)
        stopping = self.cruise / scenario.dynamics.max_acceleration
        nimble = stopping <= SOON
        self.foresight = (6.0 if nimble else stopping + REACTION) if foresight is None else foresight
        self.paces = (1.0,) if nimble else (0.0, 0.5, 1.0)

    def drive(self, observations: np.ndarray) -> tuple[np.ndarray, ...]:
        """See `Driver.drive`."""
        return self.speed(observations), self.pursue(self.direction(observations))

    def heard(self, observations: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return which others are heard, (rows, M), and their places and directions, (rows, M, 2), in the own frame."""
        mask = self.read(observations, "message_mask") > 0.5
        place, forward = (self.read(observations, f"message_{name}")[..., :2] for name in ("position", "forward"))
        return mask, place, forward

    def speed(self, observations: np.ndarray) -> np.ndarray:
        """Return the speeds, (rows,) in m/s: nothing, where going on comes too close and waiting does not.

        Others are expected to go straight on at the speed `cruise`, or at any of `paces` of it.
        """
        if "message_mask" not in self.layout:
            return np.full(len(observations), self.cruise)
        mask, place, forward = self.heard(observations)
        points, distance = self.way_ahead(observations)
        velocities = [pace * self.cruise * forward for pace in self.paces]

        def least(path: np.ndarray, times: np.ndarray) -> np.ndarray:
            found = [nearest(path, times, place, velocity, mask, self.foresight) for velocity in velocities]
            return np.asarray(np.min(found, axis=0))

        going = least(points, distance / self.cruise)
        waiting = least(np.zeros((len(observations), 2, 2)), np.array([0.0, 1.0]))
        return np.where((going >= self.distance_to_keep(observations)) | (going > waiting), self.cruise, 0.0)

    def distance_to_keep(self, observations: np.ndarray) -> np.ndarray | float:
        """Return how far from others to stay, m, one or (rows,): farther, the less sure one is of one's own place."""
        if "position_std" not in self.layout:
            return self.clearance
        std = 10.0 ** self.read(observations, "position_std")[:, 0]
        return np.asarray(np.minimum(self.closest + std, self.clearance))


def nearest(
    path: np.ndarray, times: np.ndarray, place: np.ndarray, velocity: np.ndarray, mask: np.ndarray, until: float
) -> np.ndarray:
    """Return how near others come, (rows,) in m; infinite where there is nobody.

    Args:
        path: (rows, P, 2), m, one's own places at these times, between which one drives straight, and on beyond.
        times: (P,), s.
        place: (rows, M, 2), m, of others now.
        velocity: (rows, M, 2), m/s, of others.
        mask: (rows, M) who counts.
        until: s.
    """
    found = np.full(len(path), np.inf)
    for k in range(len(times) - 1):
        begin, end = times[k], times[k + 1] if k < len(times) - 2 else max(until, times[k + 1])
        own = (path[:, k + 1] - path[:, k]) / (times[k + 1] - times[k])
        apart = place + velocity * begin - path[:, k][:, None]
        away = velocity - own[:, None]
        square = np.maximum((away**2).sum(axis=-1), 1e-9)
        time = np.clip(-(apart * away).sum(axis=-1) / square, 0.0, min(end, until) - begin)
        distance = np.linalg.norm(apart + time[..., None] * away, axis=-1)
        found = np.minimum(found, np.min(distance, axis=1, where=mask, initial=np.inf))
        if end >= until:
            break
    return found
