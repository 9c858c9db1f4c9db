"""What scripted drivers share: reading observations, the way ahead, pursuing a point. All rows are computed at once."""

from abc import ABC, abstractmethod

import numpy as np

from coopenv.api.terms.layout import observation_layout
from coopenv.scenario import Scenario

MULTIPLES = np.array([1.0, 2.0, 4.0, 8.0])
"""Of `observation.route_step`: how far ahead the entries of `route_ahead` are."""

SMALL = (0.586, 0.25)
"""Length and width, m, of the car that distances are chosen for (SVEA); they grow with larger ones."""

PURSUED = 5.0
"""Decisions in which one gets to the point that is pursued, at least: one steers before one is past it."""


class Driver(ABC):
    """A policy that chooses speed and steering for every row from its observation alone."""

    needs: tuple[str, ...] = ()
    """Fields of the observation without which it cannot drive."""

    def __init__(self, scenario: Scenario, *, cruise: float | None = None, look_ahead: float | None = None) -> None:
        """Learn where everything stands in an observation.

        Args:
            scenario: of the environment.
            cruise: speed when nothing is in the way, m/s (None: top speed).
            look_ahead: distance of the point of the way that is pursued, m (None: 1 m, or more where cars are fast).

        Raises:
            ValueError: the observation lacks a field, or the environment does not take speeds.
        """
        if scenario.action.longitudinal != "speed":
            raise ValueError("it chooses speeds, so it needs action.longitudinal = 'speed'")
        self.layout = observation_layout(scenario)
        known = {*self.layout, "way" if {"route_ahead", "goal"} & {*self.layout} else ""}
        if missing := [name for name in (*self.needs, "way") if name not in known]:
            raise ValueError(f"the observation lacks {', '.join(missing)} (way: the group route or goal)")
        self.cruise = self.layout.action[0].high if cruise is None else cruise
        least = PURSUED * self.cruise / scenario.rates.decision
        self.look_ahead = max(1.0, least) if look_ahead is None else look_ahead
        self.length, self.width = body_of_driven(scenario)
        self.scale = max(1.0, self.length / SMALL[0])
        # The reference point of highway-env's cars is midway between axles that stand at their ends, not the rear one.
        self.midway = scenario.backend == "highway"
        self.wheelbase = self.length if self.midway else scenario.dynamics.wheelbase
        self._distances = scenario.observation.route_step * MULTIPLES

    @abstractmethod
    def drive(self, observations: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return speed, m/s, steering angle, rad (positive to the left), and maybe the camera's pan, (rows,) each."""

    def __call__(self, observations: np.ndarray) -> np.ndarray:
        """Return the actions, (rows, A), for observations (rows, D)."""
        actions = np.zeros((len(observations), len(self.layout.action)), dtype=np.float32)
        wanted = self.drive(np.asarray(observations, dtype=np.float32))
        for k, (field, values) in enumerate(zip(self.layout.action, wanted, strict=False)):
            actions[:, k] = np.clip(2.0 * (values - field.low) / (field.high - field.low) - 1.0, -1.0, 1.0)
        return actions

    def read(self, observations: np.ndarray, name: str) -> np.ndarray:
        """Return a field of the observations in its unit, (rows, *shape)."""
        return self.layout[name].values(observations)

    def known(self, observations: np.ndarray) -> np.ndarray:
        """Return which landmarks of the map there are, (rows, K): all, where the observation has no `map_mask`."""
        if "map_mask" in self.layout:
            return self.read(observations, "map_mask") > 0.5
        return np.ones((len(observations), self.layout["map_position"].shape[0]), dtype=bool)

    def way_ahead(self, observations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return points of the way ahead, (rows, P, 2), m, in the own frame, and how far along it they are, (P,), m.

        The first is the vehicle's own place. Without the group `route` the way leads straight to the goal.
        """
        distance = np.concatenate([[0.0], self._distances])
        if "route_ahead" in self.layout:
            angle = self.read(observations, "route_ahead")
        else:
            goal = self.read(observations, "goal")
            angle = np.repeat(np.arctan2(goal[:, 1], goal[:, 0])[:, None], len(self._distances), axis=1)
        points = self._distances[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        return np.concatenate([np.zeros((len(points), 1, 2)), points], axis=1), distance

    def direction(self, observations: np.ndarray) -> np.ndarray:
        """Return the direction, (rows,) in rad from straight ahead, of the point of the way that is pursued."""
        points, distance = self.way_ahead(observations)
        place = int(np.clip(np.searchsorted(distance, self.look_ahead), 1, len(distance) - 1))
        share = np.clip((self.look_ahead - distance[place - 1]) / (distance[place] - distance[place - 1]), 0.0, 1.0)
        point = points[:, place - 1] + share * (points[:, place] - points[:, place - 1])
        return np.asarray(np.arctan2(point[:, 1], point[:, 0]))

    def pursue(self, direction: np.ndarray) -> np.ndarray:
        """Return the steering angles, (rows,), that lead along a circle to a point `look_ahead` away, all in rad.

        Source: Coulter, Implementation of the Pure Pursuit Path Tracking Algorithm, 1992. What lies behind counts as
        beside.
        """
        turn = np.clip((direction + np.pi) % (2.0 * np.pi) - np.pi, -np.pi / 2.0, np.pi / 2.0)
        circle = self.look_ahead + (self.wheelbase * np.cos(turn) if self.midway else 0.0)
        return np.asarray(np.arctan(2.0 * self.wheelbase * np.sin(turn) / circle))


def body_of_driven(scenario: Scenario) -> tuple[float, float]:
    """Return length and width, m, of the longest vehicle that is driven; `SMALL` where none has a body."""
    bodies = [vehicle.body.size for vehicle in scenario.vehicles if vehicle.motion.kind == "driven" and vehicle.body]
    length, width, _ = max(bodies, default=(*SMALL, 0.0))
    return length, width


class ConstantSpeed(Driver):
    """Straight on at full speed, whatever happens."""

    def drive(self, observations: np.ndarray) -> tuple[np.ndarray, ...]:
        """See `Driver.drive`."""
        return np.full(len(observations), self.cruise), np.zeros(len(observations))
