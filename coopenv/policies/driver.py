"""What scripted drivers share: reading observations, pursuing a point, giving way. All rows are computed at once."""

from abc import ABC, abstractmethod

import numpy as np

from coopenv.api.terms.layout import observation_layout
from coopenv.scenario import Scenario


class Driver(ABC):
    """A policy that chooses a speed and a heading for every row from its observation alone."""

    needs: tuple[str, ...] = ("goal",)
    """Fields of the observation without which it cannot drive."""

    def __init__(self, scenario: Scenario) -> None:
        """Learn where everything stands in an observation; ValueError: something needed is missing."""
        if scenario.action.longitudinal != "speed":
            raise ValueError("it chooses speeds, so it needs action.longitudinal = 'speed'")
        self.layout = observation_layout(scenario)
        if missing := [name for name in self.needs if name not in self.layout]:
            raise ValueError(f"the observation lacks {', '.join(missing)}")
        self.top_speed = self.layout.action[0].high
        self.wheelbase = scenario.dynamics.wheelbase

    @abstractmethod
    def drive(self, observations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return speeds in m/s and steering angles in rad (positive to the left), (rows,) each."""

    def __call__(self, observations: np.ndarray) -> np.ndarray:
        """Return the actions, (rows, A), for observations (rows, D)."""
        wanted = self.drive(np.asarray(observations, dtype=np.float32))
        actions = np.zeros((len(observations), len(self.layout.action)), dtype=np.float32)
        for k, (field, values) in enumerate(zip(self.layout.action[:2], wanted, strict=True)):
            actions[:, k] = np.clip(2.0 * (values - field.low) / (field.high - field.low) - 1.0, -1.0, 1.0)
        return actions

    def read(self, observations: np.ndarray, name: str) -> np.ndarray:
        """Return a field of the observations in its unit, (rows, *shape)."""
        return self.layout[name].values(observations)

    def pursue(self, point: np.ndarray) -> np.ndarray:
        """Return the steering angles, (rows,) in rad, of the circles through points (rows, 2) in the own frame, m.

        Source: Coulter, Implementation of the Pure Pursuit Path Tracking Algorithm, 1992. Points behind count as
        beside.
        """
        ahead = np.maximum(point[:, 0], 0.0)
        squared = np.maximum(ahead**2 + point[:, 1] ** 2, 1e-6)
        return np.asarray(np.arctan(2.0 * self.wheelbase * point[:, 1] / squared))


def closest_approach(position: np.ndarray, velocity: np.ndarray, until: float) -> np.ndarray:
    """Return how near to the origin points come that move on straight: (..., 2) in m and m/s, within `until` s."""
    square = np.maximum((velocity**2).sum(axis=-1), 1e-9)
    time = np.clip(-(position * velocity).sum(axis=-1) / square, 0.0, until)
    return np.asarray(np.linalg.norm(position + time[..., None] * velocity, axis=-1))
