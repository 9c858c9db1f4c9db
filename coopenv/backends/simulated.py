"""Simulated worlds."""

from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from coopenv.backends.base import Capabilities, Episode, SensingWorld, TickGenerator
from coopenv.estimation.outcomes import Sight
from coopenv.observers.contract import sealed
from coopenv.observers.recording import Sensed, Truth, is_due
from coopenv.observers.registry import find_embedded
from coopenv.observers.runner import start_covariances
from coopenv.scenario import Scenario
from coopenv.world.embedded import HOST


class SimulatedWorld(SensingWorld):
    """A world that reads what vehicles sense from its state: copies in float64, bearings in the body frame."""

    @cached_property
    def _markers(self) -> np.ndarray:
        """(L, 3, 1) of the landmarks, m."""
        return np.array([landmark.marker for landmark in self.scenario.landmarks], float).reshape(-1, 3, 1)

    @cached_property
    def _from_body(self) -> np.ndarray:
        """(N, 3, 3) body to camera."""
        to_body: np.ndarray = self.model.camera.numpy()["rotation"].astype(float)
        return to_body.swapaxes(-1, -2)

    def sensed(self, world: int, k: int) -> Sensed:
        """Return what the vehicles of one world sense now, at tick k."""
        L, rates = len(self._markers), self.scenario.rates
        visible = self._copy("sight", world) == Sight.VISIBLE
        bearings = np.where(visible[..., None], self._pointed("bearing", world) @ self._from_body, np.nan)
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
        pan = None if self.scenario.action.pan is None else sealed(self._copy("pan", world))
        due = bool(is_due(k, self.model.observer.rate / rates.camera))
        return Sensed(index=k, dt=1.0 / rates.camera, due=due, pan=pan, **arrays)

    def full_tick(self, k: int) -> Sensed:
        """Return the tick of the first world with truth and deliveries."""
        L = len(self._markers)
        taken = self._copy("odometry_samples", 0)
        now = k / self.scenario.rates.camera
        return replace(
            self.sensed(0, k),
            odometry_age=np.where(taken > 0, now - (taken - 1) / self.scenario.rates.odometry, np.inf),
            truth=Truth(self._copy("rotation", 0)[L:], self._copy("position", 0)[L:]),
            inbox_tick=self.view("inbox_tick")[0].astype(np.int64),
        )

    def _turned(self, name: str, world: int) -> np.ndarray:
        """Return rotations that are so in float64 too: over thousands of ticks float32's rounding would add up."""
        R = self._copy(name, world)
        if self.precision.numpy is np.float32:
            R = R @ (1.5 * np.eye(3) - 0.5 * np.swapaxes(R, -1, -2) @ R)  # a Newton step towards the nearest rotation
        return R

    def _pointed(self, name: str, world: int) -> np.ndarray:
        """Return unit vectors that are so in float64 too; zero where nothing has been measured."""
        b = self._copy(name, world)
        if self.precision.numpy is np.float32:
            b /= np.maximum(np.linalg.norm(b, axis=-1, keepdims=True), 0.5)
        return b

    def _copy(self, name: str, world: int) -> np.ndarray:
        return np.array(self.view(name)[world], dtype=float)


class Simulated(TickGenerator):
    """Worlds that are computed: many at once on a device, or one of them tick by tick."""

    def __init__(self, scenario: Scenario) -> None:
        """Simulate a scenario."""
        driven, ticks = scenario.driven, scenario.horizon_ticks + 1
        capabilities = Capabilities(truth=True, driven=driven, real_time=False, ticks=ticks, batched=True)
        super().__init__(scenario, capabilities)
        self._world: SimulatedWorld | None = None

    def kind(self, *arguments: Any, **options: Any) -> SimulatedWorld:
        """Return worlds; arguments and errors as for `World`."""
        return SimulatedWorld(*arguments, **options)

    def world(self, worlds: int, dtype: str, device: str, threads: int | None) -> SimulatedWorld:
        """Return the worlds, with the observer that the scenario names."""
        observer = find_embedded(self.scenario.observer.name) or HOST
        start = start_covariances(self.scenario)
        return self.kind(self.scenario, worlds, dtype, device, threads, observer, start)

    def episode(self, seed: int | None, options: Mapping[str, Any]) -> Episode:
        """Simulate one world in float64, without an observer: deliveries do not depend on the contents of messages."""
        if self._world is None:
            self._world = self.kind(self.scenario, 1, "float64", threads=1)
        world, acting = self._world, [vehicle.motion.kind != "traffic" for vehicle in self.scenario.vehicles]
        world.reset(None if seed is None else [seed])
        command = yield world.full_tick(0)
        for k in range(1, self.scenario.horizon_ticks + 1):
            world.view("command")[0, acting] = command.rows[acting]
            world.fetch()
            world.sense()
            for vehicle in world.observer_init.order:
                world.receive(vehicle)
                world.broadcast(vehicle)
            world.finish()
            command = yield world.full_tick(k)
