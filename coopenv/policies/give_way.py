"""A scripted driver: towards the goal, giving way to the vehicles that it hears."""

import numpy as np

from coopenv.api.terms.layout import observation_layout
from coopenv.scenario import Scenario


class GiveWay:
    """Pure pursuit of the goal in the vehicle's own estimated frame; stops where driving on would come too close.

    In the leader-follower order a vehicle hears its leaders only, so giving way to whomever one hears cannot
    deadlock. Needs `action.longitudinal = "speed"`.
    """

    def __init__(
        self,
        scenario: Scenario,
        *,
        cruise: float = 0.6,
        clearance: float = 0.9,
        foresight: float = 6.0,
        look_ahead: float = 1.2,
        steering_gain: float = 1.5,
    ) -> None:
        """Choose the manner of driving.

        Args:
            scenario: of the environment; its observation needs the groups goal and messages.
            cruise: speed when nothing is in the way, m/s; also what others are expected to drive.
            clearance: distance to keep between reference points, m.
            foresight: how far ahead to look, s.
            look_ahead: distance over which the heading to the goal is closed, m.
            steering_gain: steering share per rad of heading error.
        """
        if scenario.action.longitudinal != "speed":
            raise ValueError("it chooses speeds, so it needs action.longitudinal = 'speed'")
        self._layout = observation_layout(scenario)
        needed = ("goal", "message_position", "message_forward", "message_mask")
        if missing := [name for name in needed if name not in self._layout]:
            raise ValueError(f"the observation lacks {', '.join(missing)}")
        self._speed = self._layout.action[0]
        self._cruise, self._clearance = cruise, clearance
        self._times = np.linspace(0.0, foresight, 31)
        self._look_ahead, self._gain = look_ahead, steering_gain

    def _read(self, observation: np.ndarray, name: str) -> np.ndarray:
        field = self._layout[name]
        return observation[field.slice].reshape(field.shape) * field.scale

    def _closest(self, position: np.ndarray, velocity: np.ndarray, speed: float) -> float:
        """Return the smallest distance ahead of us if we drive straight at `speed` and others keep their velocity."""
        relative = velocity - np.array([speed, 0.0])
        path = position[None] + self._times[:, None, None] * relative[None]
        return float(np.linalg.norm(path, axis=-1).min(initial=np.inf))

    def __call__(self, observations: np.ndarray) -> np.ndarray:
        """Return the actions (speed, steering), (N, 2), for observations (N, D)."""
        return np.stack([self._act(observation) for observation in observations])

    def _act(self, observation: np.ndarray) -> np.ndarray:
        goal = self._read(observation, "goal")
        heading = float(np.arctan2(goal[1], max(goal[0], self._look_ahead)))
        heard = self._read(observation, "message_mask") > 0.5
        position = self._read(observation, "message_position")[heard, :2]
        velocity = self._cruise * self._read(observation, "message_forward")[heard, :2]
        going, waiting = (self._closest(position, velocity, speed) for speed in (self._cruise, 0.0))
        speed = self._cruise if going >= self._clearance or going > waiting else 0.0
        return np.array([self._speed.level(speed), np.clip(self._gain * heading, -1.0, 1.0)], dtype=np.float32)
