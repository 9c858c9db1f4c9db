"""Observers that run on the host in place of the embedded one."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from coopenv.base.errors import CoopenvError
from coopenv.estimation.poses import Coordinates, riccati_covariance
from coopenv.observers.contract import Estimate
from coopenv.observers.faults import Interference, interference_of
from coopenv.observers.group import ObserverError, ObserverGroup
from coopenv.observers.registry import find, states_covariance
from coopenv.observers.sensed import Sensed
from coopenv.sources.base import SensingWorld
from coopenv.world.quality import COORDINATES


class PlugIns:
    """A group of observers per world.

    Estimates are written into the world's state, from which observations, rewards and metrics follow as for the
    embedded observer. Where an estimate has no covariance, the scenario's P(0) stands for it.
    """

    def __init__(self, name: str, world: SensingWorld) -> None:
        """Find the observer.

        Raises:
            CoopenvError: no such observer, or the world is not on the CPU.
        """
        factory = find(name)
        if world.scenario.topology.most_nearby is not None:
            raise CoopenvError(f"topology.most_nearby: observer '{name}' runs on the host and keeps all; leave it out")
        if world.device != "cpu":
            raise CoopenvError(f"observer '{name}' runs on the host; use device='cpu' instead of '{world.device}'")
        self.name, self._world = name, world
        observer_init = world.observer_init
        self.groups = [ObserverGroup(factory, observer_init) for _ in range(world.worlds)]
        self._order = observer_init.order
        self._ticking = np.zeros(world.worlds, dtype=bool)  # worlds that are in the tick under way
        self._failures: dict[int, str] = {}

    def start(self, worlds: np.ndarray) -> None:
        """Start the observers of the given worlds (indices), which have just been reset.

        Raises:
            CoopenvError: an observer cannot start.
        """
        R, p = self._world.view("estimate_rotation"), self._world.view("estimate_position")
        for w in worlds.tolist():
            self._failures.pop(w, None)
            rotation = np.array(R[w], dtype=float)
            position = (rotation @ np.array(p[w], dtype=float)[..., None])[..., 0]
            with self._naming_the_observer():
                self.groups[w].start(rotation, position, self._interference(w, 0))
            if states_covariance(self.name):
                for vehicle, P in enumerate(self._world.observer_init.start_covariance):
                    self._write_covariance(w, vehicle, Estimate(rotation[vehicle], position[vehicle], P))

    def load(self) -> None:
        """Load the kernels of the stages, see `World.load`."""
        world = self._world
        world.restart()
        world.mask.fill_(1)
        world.decide()
        world.sense()
        world.receive(0)
        world.broadcast(0)
        world.finish()
        world.mask.zero_()

    def advance(self, ticks: int) -> None:
        """Run camera ticks, stopping each world at its horizon; worlds in the world's mask stay as they are.

        Raises:
            CoopenvError: an observer failed; its world has to be reset.
        """
        self._world.decide()
        for _ in range(ticks):
            active = (self._world.mask.numpy() == 0) & (self._world.view("tick") < self._world.model.horizon_ticks)
            if not active.any() or not self._world.fetch():
                return
            self._tick(active)

    def _tick(self, active: np.ndarray) -> None:
        world, worlds = self._world, np.flatnonzero(active).tolist()
        for w in worlds:
            if w in self._failures:
                raise CoopenvError(f"{self._failures[w]} (reset starts anew)")
        self._ticking = active
        world.sense()
        sensed = {w: world.sensed(w, int(world.view("tick")[w]) + 1) for w in worlds}
        joint = self.groups[0].joint
        with self._naming_the_observer():
            for w in worlds if joint else ():
                faults = self._interference(w, sensed[w].index)
                for i, answer in enumerate(self.groups[w].update_all(sensed[w], faults)):
                    self._write(w, i, answer.estimate)
            for vehicle in self._order:
                world.receive(vehicle)
                for w in () if joint else worlds:
                    self._write(w, vehicle, self._estimate(w, vehicle, sensed[w]))
                world.broadcast(vehicle)
        world.finish()

    def _estimate(self, w: int, vehicle: int, sensed: Sensed) -> Estimate:
        interference, view = self._interference(w, sensed.index), self._world.view
        if interference is not None and interference.restarts[vehicle]:
            for name in ("inbox_tick", "inbox_stamp"):
                view(name)[w, vehicle] = -1
        return self.groups[w].update(vehicle, sensed, view("inbox_tick")[w, vehicle], interference).estimate

    def _interference(self, w: int, k: int) -> Interference | None:
        return interference_of(self._world.scenario, self._world.model, self._world.view, w, k)

    @contextmanager
    def _naming_the_observer(self) -> Iterator[None]:
        """Name the observer in an error, and remember it for the worlds that were in this tick: it has no end."""
        try:
            yield
        except ObserverError as failure:
            message = f"observer '{self.name}' {failure}"
            self._failures.update(dict.fromkeys(np.flatnonzero(self._ticking).tolist(), message))
            raise CoopenvError(message) from failure.__cause__

    def _write(self, w: int, vehicle: int, estimate: Estimate) -> None:
        R, view = np.asarray(estimate.rotation, dtype=float), self._world.view
        view("estimate_rotation")[w, vehicle] = R
        view("estimate_position")[w, vehicle] = R.T @ np.asarray(estimate.position, dtype=float)
        self._write_covariance(w, vehicle, estimate)
        view("protection_level")[w, vehicle] = 0.0 if estimate.protection_level is None else estimate.protection_level

    def _write_covariance(self, w: int, vehicle: int, estimate: Estimate) -> None:
        gains, P, coordinates = self._world.model.observer, estimate.covariance, Coordinates.RICCATI
        if P is None:
            kept = np.diag(np.repeat([float(gains.p1), float(gains.p2)], 3))
        else:
            coordinates = estimate.coordinates
            kept = riccati_covariance(coordinates, estimate.rotation, estimate.position, P)
        self._world.view("covariance")[w, vehicle] = kept
        self._world.view("coordinates")[w, vehicle] = COORDINATES.index(coordinates)

    def get_state(self) -> list[dict[str, Any]]:
        """Return a deep copy of every observer and message.

        Raises:
            CoopenvError: an observer cannot be copied.
        """
        return [group.get_state() for group in self.groups]

    def set_state(self, states: Any, begun: np.ndarray) -> None:
        """Restore a state of `get_state`, of worlds (W,) of which some have begun.

        Raises:
            CoopenvError: it is of other observers; nothing has changed then.
        """
        if not isinstance(states, list) or len(states) != len(self.groups):
            raise CoopenvError(f"state: no observers '{self.name}' in it")
        copies = [group.checked_state(*state) for group, *state in zip(self.groups, states, begun, strict=True)]
        for group, state in zip(self.groups, copies, strict=True):
            group.set_state(state)
        self._failures.clear()
