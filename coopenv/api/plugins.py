"""Observers in NumPy in place of the embedded one: the world advances tick by tick, observers run in between."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from coopenv.backends.base import SensingWorld
from coopenv.base.errors import CoopenvError
from coopenv.estimation.poses import riccati_covariance
from coopenv.observers.contract import Estimate
from coopenv.observers.group import ObserverError, ObserverGroup
from coopenv.observers.interference import Interference, interference_of
from coopenv.observers.recording import Sensed
from coopenv.observers.registry import find


class PlugIns:
    """A group of observers per world.

    Estimates are written into the world's state, from which observations, rewards and metrics follow as for the
    embedded observer. For an observer without covariance the scenario's P(0) is kept.
    """

    def __init__(self, name: str, world: SensingWorld) -> None:
        """Find the observer.

        Raises:
            CoopenvError: no such observer, or the world is not on the CPU.
        """
        factory = find(name)
        if world.device != "cpu":
            raise CoopenvError(f"observer '{name}' runs on the host; use device='cpu' instead of '{world.device}'")
        self.name, self._world = name, world
        observer_init = world.observer_init
        self.groups = [ObserverGroup(factory, observer_init) for _ in range(world.worlds)]
        self._order: Sequence[int] = observer_init.order
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
            try:
                self.groups[w].start(rotation, position, self._interference(w, 0))
            except ObserverError as failure:
                raise self._failed(failure) from failure.__cause__

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
        if joint:
            for w in worlds:
                for i, estimate in enumerate(self._ask(w, None, sensed[w])):
                    self._write(w, i, estimate)
        for vehicle in self._order:
            world.receive(vehicle)
            for w in [] if joint else worlds:
                self._write(w, vehicle, self._ask(w, vehicle, sensed[w])[0])
            world.broadcast(vehicle)
        world.finish()

    def _ask(self, w: int, vehicle: int | None, sensed: Sensed) -> list[Estimate]:
        group = self.groups[w]
        try:
            if vehicle is None:
                return [answer.estimate for answer in group.update_all(sensed)]
            interference = self._interference(w, sensed.index)
            if interference is not None and interference.restarts[vehicle]:
                for name in ("inbox_tick", "inbox_stamp"):
                    self._world.view(name)[w, vehicle] = -1
            inbox_tick = self._world.view("inbox_tick")[w, vehicle]
            return [group.update(vehicle, sensed, inbox_tick, interference).estimate]
        except ObserverError as failure:
            raise self._failed(failure) from failure.__cause__

    def _interference(self, w: int, k: int) -> Interference | None:
        return interference_of(self._world.scenario, self._world.model, self._world.view, w, k)

    def _failed(self, failure: ObserverError) -> CoopenvError:
        """Return the error, and remember it for the worlds that were in this tick: it has no end."""
        message = f"observer '{self.name}' {failure}"
        self._failures.update(dict.fromkeys(np.flatnonzero(self._ticking).tolist(), message))
        return CoopenvError(message)

    def _write(self, w: int, vehicle: int, estimate: Estimate) -> None:
        R, view = np.asarray(estimate.rotation, dtype=float), self._world.view
        view("estimate_rotation")[w, vehicle] = R
        view("estimate_position")[w, vehicle] = R.T @ np.asarray(estimate.position, dtype=float)
        if estimate.covariance is not None:
            view("covariance")[w, vehicle] = riccati_covariance(
                estimate.coordinates, estimate.rotation, estimate.position, estimate.covariance
            )

    def get_state(self) -> list[dict[str, Any]]:
        """Return a deep copy of every observer and message.

        Raises:
            CoopenvError: an observer cannot be copied.
        """
        return [group.get_state() for group in self.groups]

    def set_state(self, states: Any, begun: np.ndarray) -> None:
        """Go back to what `get_state` returned, of worlds (W,) of which some have begun.

        Raises:
            CoopenvError: it is of other observers; nothing has changed then.
        """
        if not isinstance(states, list) or len(states) != len(self.groups):
            raise CoopenvError(f"state: no observers '{self.name}' in it")
        copies = [group.checked_state(*state) for group, *state in zip(self.groups, states, begun, strict=True)]
        for group, state in zip(self.groups, copies, strict=True):
            group.set_state(state)
        self._failures.clear()
