"""The simulated backend."""

from __future__ import annotations

import math

import numpy as np

from coopenv.estimation.trajectory import Sight
from coopenv.observers.briefing import briefing_of, start_covariances
from coopenv.observers.recording import Briefing, Sensed
from coopenv.observers.registry import find_embedded
from coopenv.scenario import Scenario
from coopenv.world.embedded import HOST
from coopenv.world.world import World


class Simulated:
    """Worlds that are computed."""

    def __init__(self, scenario: Scenario) -> None:
        self.scenario = scenario

    def world(self, worlds: int, dtype: str, device: str, threads: int | None) -> World:
        """Return the world."""
        observer = find_embedded(self.scenario.observer.name) or HOST
        return World(self.scenario, worlds, dtype, device, threads, observer, start_covariances(self.scenario))

    def senses(self, world: World) -> SimulatedSenses:
        """Return the reader of its ticks."""
        return SimulatedSenses(self.scenario, world)


class SimulatedSenses:
    """Reads what vehicles sense from a world's state: copies in float64, bearings in the body frame."""

    def __init__(self, scenario: Scenario, world: World) -> None:
        self._world = world
        self._dt = 1.0 / scenario.rates.camera
        self._ratio = world.model.observer.rate / scenario.rates.camera
        self._camera = np.array(world.model.camera.rotation, dtype=float).reshape(3, 3)
        self._markers = np.array([landmark.marker for landmark in scenario.landmarks], float).reshape(-1, 3, 1)
        self._scenario = scenario
        self._single = world.precision.numpy is np.float32

    @property
    def briefing(self) -> Briefing:
        """What the observers are told before the first tick."""
        return briefing_of(self._scenario, self._world.model)

    def read(self, world: int, k: int) -> Sensed:
        """Return what the vehicles of one world sense now, at tick k."""
        L = len(self._markers)
        visible = self._copy("sight", world) == Sight.VISIBLE
        bearings = np.where(visible[..., None], self._pointed("bearing", world) @ self._camera.T, np.nan)
        R, position = self._copy("rotation", world)[:L], self._copy("position", world)[:L]
        arrays = {
            "rotation": self._turned("increment_rotation", world),
            "translation": self._copy("increment_translation", world),
            "velocity": self._copy("odometry_velocity", world),
            "angular_velocity": self._copy("odometry_angular_velocity", world),
            "bearings": bearings,
            "visible": visible,
            "landmarks": position + (R @ self._markers)[..., 0],
        }
        for values in arrays.values():
            values.setflags(write=False)
        due = math.floor(k * self._ratio + 1e-9) > math.floor(max(k - 1, 0) * self._ratio + 1e-9)
        return Sensed(index=k, dt=self._dt, due=due, **arrays)

    def _turned(self, name: str, world: int) -> np.ndarray:
        """Return rotations that are so in float64 too: over thousands of ticks float32's rounding would add up."""
        R = self._copy(name, world)
        if self._single:
            R = R @ (1.5 * np.eye(3) - 0.5 * np.swapaxes(R, -1, -2) @ R)  # a Newton step towards the nearest rotation
        return R

    def _pointed(self, name: str, world: int) -> np.ndarray:
        """Return unit vectors that are so in float64 too; zero where nothing has been measured."""
        b = self._copy(name, world)
        if self._single:
            b /= np.maximum(np.linalg.norm(b, axis=-1, keepdims=True), 0.5)
        return b

    def _copy(self, name: str, world: int) -> np.ndarray:
        return np.array(self._world.view(name)[world], dtype=float)
