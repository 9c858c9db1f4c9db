"""A batch of worlds on a device: allocate, reset by mask, advance, save and restore."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp

from coopenv.scenario import Scenario
from coopenv.world.build import build_model
from coopenv.world.launch import Launcher
from coopenv.world.precision import check_device, precision
from coopenv.world.state import allocate_state, read_state, write_state
from coopenv.world.step import advance_kernel, reset_kernel


class World:
    """`worlds` copies of one scenario, stepped together.

    World w of a batch seeded with s has seed s + w, and its noise depends on that seed alone: it is bit for bit the
    single world seeded with s + w (on the same device).
    """

    def __init__(self, scenario: Scenario, worlds: int = 1, dtype: str = "float32", device: str = "cpu") -> None:
        """Build the arrays; call `reset` before `advance`.

        Raises:
            DeviceError: unknown precision or device.
            ValueError: no worlds.
        """
        if worlds < 1:
            raise ValueError(f"num_worlds must be at least 1, got {worlds}")
        self.scenario = scenario
        self.worlds = worlds
        self.precision = precision(dtype)
        self.device = check_device(device)
        self.model = build_model(scenario, self.precision, self.device)
        self.state = allocate_state(self.model, worlds, self.precision, self.device)
        N = self.model.vehicles
        self.actions = wp.zeros((worlds, N), dtype=self.precision.vec2, device=self.device)
        self.mask = wp.zeros(worlds, dtype=wp.int32, device=self.device)
        self._launch = Launcher(worlds, self.device, dtype)

    def reset(self, seeds: Sequence[int] | np.ndarray | None = None, mask: np.ndarray | None = None) -> None:
        """Start a new episode in the worlds of `mask` (all by default).

        Args:
            seeds: one per world, reduced modulo 2^64; None keeps each world's seed and draws a new episode from it.
            mask: (W,) bool.
        """
        chosen = np.ones(self.worlds, dtype=bool) if mask is None else np.asarray(mask, dtype=bool)
        seed, episode = self.state.seed.numpy(), self.state.episode.numpy()
        if seeds is None:
            episode = np.where(chosen, episode + np.uint32(1), episode)
        else:
            wanted = np.array([int(s) % 2**64 for s in seeds], dtype=np.uint64)
            seed, episode = np.where(chosen, wanted, seed), np.where(chosen, np.uint32(0), episode)
        self.state.seed.assign(seed.astype(np.uint64))
        self.state.episode.assign(episode.astype(np.uint32))
        self.mask.assign(chosen.astype(np.int32))
        self._launch("reset", reset_kernel, [self.model, self.state, self.mask])

    def advance(self, ticks: int) -> None:
        """Run camera ticks under `self.actions`, stopping each world at its horizon."""
        self._launch(("advance", ticks), advance_kernel, [self.model, self.state, self.state, self.actions, ticks])

    def get_state(self) -> dict[str, np.ndarray]:
        """Return a copy of everything that changes, random streams included (they are seeds and counters)."""
        return {**read_state(self.state, self.precision), "actions": self.actions.numpy().copy()}

    def set_state(self, values: dict[str, np.ndarray]) -> None:
        """Restore what `get_state` returned.

        Raises:
            ValueError: a field is missing or has another shape.
        """
        write_state(self.state, values, self.precision)
        self.actions.assign(values["actions"])
