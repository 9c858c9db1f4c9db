"""The baseline: along the way at full speed, giving way to the vehicles that it hears."""

import numpy as np

from coopenv.policies.driver import Driver, closest_approach
from coopenv.scenario import Scenario

MESSAGES = ("message_position", "message_forward", "message_mask")


class RouteFollower(Driver):
    """Pure pursuit of the way by the vehicle's own estimate; stops where driving on would come too close to others.

    In the leader-follower order a vehicle hears its leaders only, so giving way to whomever one hears cannot deadlock.
    """

    needs = ("goal", *MESSAGES)

    def __init__(
        self,
        scenario: Scenario,
        *,
        cruise: float | None = None,
        clearance: float = 0.9,
        foresight: float = 6.0,
        look_ahead: float = 1.2,
    ) -> None:
        """Choose the manner of driving.

        Args:
            scenario: of the environment.
            cruise: speed when nothing is in the way, m/s; also what others are expected to drive (None: top speed).
            clearance: distance to keep between reference points, m.
            foresight: how far ahead to look for others, s.
            look_ahead: distance of the point that is pursued, m.
        """
        super().__init__(scenario)
        self.cruise = self.top_speed if cruise is None else cruise
        self.clearance, self.foresight, self.look_ahead = clearance, foresight, look_ahead

    def drive(self, observations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See `Driver.drive`."""
        return self.speed(observations), self.pursue(self.point_ahead(observations))

    def point_ahead(self, observations: np.ndarray) -> np.ndarray:
        """Return the point that is pursued, (rows, 2), m, own frame: so far ahead in the goal's direction."""
        goal = self.read(observations, "goal")[:, :2]
        distance = np.maximum(np.linalg.norm(goal, axis=1, keepdims=True), 1e-6)
        return np.asarray(goal * (self.look_ahead / distance))

    def speed(self, observations: np.ndarray) -> np.ndarray:
        """Return the speeds, (rows,) in m/s: nothing, where going on comes too close and waiting does not."""
        heard = self.read(observations, "message_mask") > 0.5
        position = self.read(observations, "message_position")[..., :2]
        velocity = self.cruise * self.read(observations, "message_forward")[..., :2]
        going, waiting = (
            np.min(
                closest_approach(position, velocity - np.array([speed, 0.0]), self.foresight),
                axis=1,
                where=heard,
                initial=np.inf,
            )
            for speed in (self.cruise, 0.0)
        )
        return np.where((going >= self.clearance) | (going > waiting), self.cruise, 0.0)
