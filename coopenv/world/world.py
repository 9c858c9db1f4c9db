"""A batch of worlds on a device: allocate, reset by mask, advance, save and restore."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
import warp as wp

from coopenv.errors import CoopenvError
from coopenv.scenario import Scenario
from coopenv.world.build import EMBEDDED, build_model
from coopenv.world.embedded import ROBUST, Kernels, kernels_of
from coopenv.world.launch import Launcher, PerWorld, default_threads
from coopenv.world.precision import check_device, precision
from coopenv.world.stages import broadcast_kernel, deliver_kernel, finish_kernel, sense_kernel
from coopenv.world.state import allocate_state, check_fit, overwrite, state_fields


class World:
    """`worlds` copies of one scenario, stepped together.

    World w of a batch seeded with s has seed s + w, and its noise depends on that seed alone: it is bit for bit the
    single world seeded with s + w (on the same device).
    """

    def __init__(
        self,
        scenario: Scenario,
        worlds: int = 1,
        dtype: str = "float32",
        device: str = "cpu",
        threads: int | None = None,
    ) -> None:
        """Build the arrays; call `reset` before `advance`.

        Args:
            scenario: what to build.
            worlds: how many.
            dtype: "float32" or "float64".
            device: "cpu", "cuda", "cuda:0", ...
            threads: shares into which the batch is split on the CPU; None: by its size and the cores. Results do not
                depend on it.

        Raises:
            DeviceError: unknown precision or device.
            CoopenvError: no worlds or no threads.
        """
        for name, count in (("num_worlds", worlds), ("threads", 1 if threads is None else threads)):
            if isinstance(count, bool) or not isinstance(count, int | np.integer) or not 1 <= count < 2**31:
                raise CoopenvError(f"{name} must be at least 1, whole and below 2^31, got {count!r}")
        self.scenario = scenario
        self.worlds = worlds
        self.precision = precision(dtype)
        self.device = check_device(device)
        self.threads = default_threads(worlds, self.device) if threads is None else min(threads, worlds)
        if self.device != "cpu":
            self.threads = 1
        self.model = self._build_model()
        self.state = allocate_state(self.model, worlds, self.precision, self.device)
        self.memory: Any = self._allocate_memory()
        """What the embedded observer remembers besides the state; None where it needs no more."""
        self.actions = wp.zeros((worlds, self.model.vehicles), dtype=self.precision.vec2, device=self.device)
        self.mask = wp.zeros(worlds, dtype=wp.int32, device=self.device)
        """(W,) worlds that `restart` resets and that `advance` leaves alone; zero between calls."""
        self.launch = Launcher(worlds, self.device, dtype, self.threads)
        self._views: dict[str, np.ndarray] = {}

    def _build_model(self) -> Any:
        return build_model(self.scenario, self.precision, self.device)

    @property
    def estimates(self) -> bool:
        """Whether the scenario's observer is embedded; others run on the host, see `PlugIns`."""
        return self.scenario.observer.name in EMBEDDED

    def _allocate_memory(self) -> Any:
        if not self.estimates or self.scenario.observer.name != ROBUST:
            return None
        from coopenv.observers.robust.state import allocate_robust

        return allocate_robust(self.model, self.worlds, self._start_covariance(), self.device)

    def _start_covariance(self) -> np.ndarray:
        """Return the covariances (N, 6, 6) of the initial estimates, left errors."""
        from coopenv.observers.briefing import start_covariance

        return np.array([start_covariance(self.scenario, i) for i in range(self.model.vehicles)])

    @cached_property
    def _kernels(self) -> Kernels:
        return kernels_of(self.memory)

    def _changing(self) -> list[PerWorld]:
        return [PerWorld(record) for record in (self.state, self.memory) if record is not None]

    def reset(self, seeds: Sequence[int] | np.ndarray | None = None, mask: np.ndarray | None = None) -> None:
        """Start a new episode in the worlds of `mask` (all by default).

        Args:
            seeds: one per world, reduced modulo 2^64; None keeps each world's seed and draws a new episode from it.
            mask: (W,) bool.
        """
        chosen = np.ones(self.worlds, dtype=bool) if mask is None else np.asarray(mask, dtype=bool)
        if seeds is not None:
            wanted = np.array([int(s) % 2**64 for s in seeds], dtype=np.uint64)
            self.state.seed.assign(np.where(chosen, wanted, self.state.seed.numpy()))
            # restart() raises the episode's number by one: the first one of a seed is 0
            self.state.episode.assign(np.where(chosen, np.uint32(2**32 - 1), self.state.episode.numpy()))
        self.mask.assign(chosen.astype(np.int32))
        self.restart()
        self.mask.zero_()

    def restart(self) -> None:
        """Start the next episode in the worlds of `self.mask`, on the device."""
        self.launch("restart", self._kernels.reset, [self.model, *self._changing(), PerWorld(self.mask)])

    def advance(self, ticks: int) -> None:
        """Run camera ticks under `self.actions`, stopping each world at its horizon."""
        moving = [*self._changing(), PerWorld(self.actions), PerWorld(self.mask), ticks]
        self.launch(("advance", ticks), self._kernels.advance, [self.model, *moving])

    # One tick in stages, for estimators on the host: sense, then per vehicle deliver and broadcast, then finish.

    def sense(self, active: Any) -> None:
        """Move the truth of the active worlds (W,) to the next tick and measure it."""
        self.launch("sense", sense_kernel, [self.model, *self._arguments(active), PerWorld(self.actions)])

    def deliver(self, active: Any, vehicle: int) -> None:
        """Let a vehicle of the active worlds receive what arrives at this tick."""
        self.launch(("deliver", vehicle), deliver_kernel, [self.model, *self._arguments(active), vehicle])

    def broadcast(self, active: Any, vehicle: int) -> None:
        """Let a vehicle of the active worlds, whose estimate has been written, send it."""
        self.launch(("broadcast", vehicle), broadcast_kernel, [self.model, *self._arguments(active), vehicle])

    def finish(self, active: Any) -> None:
        """End the tick of the active worlds."""
        self.launch("finish", finish_kernel, [self.model, *self._arguments(active), PerWorld(self.actions)])

    def _arguments(self, active: Any) -> list[PerWorld]:
        return [PerWorld(self.state), PerWorld(active)]

    def view(self, name: str) -> np.ndarray:
        """Return a field of the state on the host, without a copy on the CPU."""
        view = self._views.get(name)
        if view is None:
            view = getattr(self.state, name).numpy()
            if self.device == "cpu":
                self._views[name] = view
        return view

    def get_state(self) -> dict[str, np.ndarray]:
        """Return a copy of everything that changes, random streams included (they are seeds and counters)."""
        return {name: array.numpy().copy() for name, array in self.state_arrays().items()}

    def set_state(self, values: Mapping[str, np.ndarray]) -> None:
        """Restore what `get_state` returned.

        Raises:
            ValueError: a field is missing or has another shape.
        """
        check_fit(self.state_arrays(), values)
        overwrite(self.state_arrays(), values)

    def state_arrays(self) -> dict[str, Any]:
        """Return every array that `set_state` writes, by name."""
        fields = {name: getattr(self.state, name) for name in state_fields(self.precision)}
        remembered = [] if self.memory is None else list(self.memory._cls.vars)
        own = {f"observer_{name}": getattr(self.memory, name) for name in remembered}
        return {**fields, **own, "actions": self.actions}
