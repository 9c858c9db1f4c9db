"""The batched core under every interface: worlds plus step results, with constant Python work per step.

The results of a step (observations, reward terms, judgements) are computed on the device.
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
import warp as wp

from coopenv.api.plugins import PlugIns
from coopenv.api.reward import RewardFunction, Step, check_function, reward_of
from coopenv.api.terms.layout import Layout, observation_layout
from coopenv.api.terms.own import OwnTerms
from coopenv.api.terms.results import MEMORY, results_struct, results_table, step_results
from coopenv.backends.base import Backend
from coopenv.backends.sources import simulation_of
from coopenv.backends.tick_world import open_world
from coopenv.base.errors import CoopenvError, check_memory, error_text, training_seed, world_keys
from coopenv.scenario import Scenario
from coopenv.world.embedded import HOST
from coopenv.world.launch import PerWorld
from coopenv.world.model import device_memory
from coopenv.world.state import allocate, has_begun, overwrite, size_of, state_fields
from coopenv.world.world import Keys, World


class Report:
    """The arrays of the step results of a world, and what fills them."""

    def __init__(
        self,
        scenario: Scenario,
        world: World,
        layout: Layout,
        reward: RewardFunction | None,
        view: Callable[[str], np.ndarray],
    ) -> None:
        """Allocate the results and bind the scenario's terms.

        Args:
            scenario: names the terms.
            world: whose state is reported.
            layout: of the observation.
            reward: in place of the scenario's weighted sum; on the CPU only.
            view: returns fields of results and state on the host.

        Raises:
            CoopenvError: a term does not exist or fails, or the results would not fit into memory.
        """
        self._world, self._view, p = world, view, world.precision
        terms = len(scenario.reward.by_name)
        sizes = {"W": world.worlds, "N": world.model.vehicles, "D": layout.size, "K": terms}
        needed = size_of(results_struct(p), sizes)
        check_memory(needed, f"results of {world.worlds} worlds", device_memory(world.device))
        self.results = allocate(results_struct(p), sizes, world.device)
        self._own = OwnTerms(scenario, world, layout, self.results)
        check_function(reward, world.device)
        self._reward, self._step = reward, Step(view, scenario)
        self._table = results_table(scenario, layout, world.device)

    def end_episodes(self) -> None:
        """End the episodes of vehicles that fulfil a condition of the user."""
        self._own.end_episodes()

    def fill(self, key: str, fresh: Any, chosen: Any) -> None:
        """Compute the results of the worlds in `chosen` (W,); in those of `fresh` (W,) an episode has just begun."""
        world = self._world
        parts = [PerWorld(part) for part in (self._own.records, self.results, fresh, chosen)]
        arguments = [world.model, PerWorld(world.state), self._table, *parts]
        world.launch(key, step_results, arguments, inner=(world.model.vehicles,))
        self._own.fill(key, fresh, chosen)
        if world.device == "cpu":  # reading from a GPU would wait for it
            self._own.check(self._view)

    def reward_anew(self, fresh: Any) -> None:
        """Replace the reward of the worlds that have not just been reset by that of a function in Python."""
        if self._reward is not None:
            earning = self._view("alive") & (fresh.numpy()[:, None] == 0)
            self._view("reward")[...] = reward_of(self._reward, self._step, earning)


class Engine:
    """`worlds` worlds with their observations, rewards and judgements.

    Host views: `view(name)` gives a field of the results or the state as a NumPy array (W, N, ...) or (W, A, ...),
    without a copy on the CPU; copy what must outlive the next step.
    """

    def __init__(
        self,
        scenario: Scenario,
        worlds: int = 1,
        dtype: str = "float32",
        device: str = "cpu",
        threads: int | None = None,
        backend: Backend | None = None,
        reward: RewardFunction | None = None,
    ) -> None:
        """Build everything; arguments and errors as for `World`.

        Args:
            scenario: what to build.
            worlds: how many.
            dtype: "float32" or "float64".
            device: "cpu" or a CUDA device.
            threads: shares of the batch on the CPU.
            backend: where ticks come from (None: computed).
            reward: in place of the scenario's weighted sum; on the CPU only.
        """
        self.backend: Backend = backend or simulation_of(scenario)
        self.world = open_world(self.backend, worlds, dtype, device, threads)
        on_host = self.world.observer is HOST
        self.plugins = PlugIns(scenario.observer.name, self.world) if on_host else None
        """The observers that run on the host; None where the embedded one estimates."""
        self.layout = observation_layout(scenario)
        self.reward_terms = tuple(scenario.reward.by_name)
        """Names of the reward terms, in the order of the field `terms`."""
        self._views: dict[str, np.ndarray] = {}
        self._state_fields = set(state_fields(self.world.precision))
        self._report = Report(scenario, self.world, self.layout, reward, self.view)
        self.results = self._report.results
        worlds, device = self.world.worlds, self.world.device
        flags: list[Any] = [wp.full(worlds, value, dtype=wp.int32, device=device) for value in (1, 0, 0)]
        self._everywhere, self._nowhere, self._fresh = flags
        self.begun = False
        """Whether every world has been reset, or restored from one that had."""

    def reset(
        self,
        seeds: Keys = None,
        mask: np.ndarray | None = None,
        options: Mapping[str, Any] | None = None,
        parameters: Mapping[str, np.ndarray] | None = None,
    ) -> Keys:
        """Start new episodes, see `World.reset`; the results of the other worlds stay.

        The first reset is of all worlds, and draws a seed for training where none is given. `parameters` are set
        before, in the worlds that are reset, see `World.set_parameters`.

        Returns:
            The keys of the worlds, or None where they go on from their last ones.
        """
        if self.backend.capabilities.real_time:
            self.load()  # before anybody waits for a command
        if not self.begun:
            mask = None
            drawn = world_keys(training_seed(), self.world.worlds)
            seeds = drawn if seeds is None else [b if a is None else a for a, b in zip(seeds, drawn, strict=True)]
        chosen = np.ones(self.world.worlds, dtype=bool) if mask is None else np.asarray(mask, dtype=bool)
        if parameters:
            self.world.set_parameters(parameters, chosen)
        self.world.reset(seeds, mask, options)
        if self.plugins is not None:
            self.plugins.start(np.flatnonzero(chosen))
        self._fresh.assign(chosen.astype(np.int32))
        self._report.fill("results fresh", self._fresh, self._fresh)
        if self.backend.capabilities.real_time and not self.begun:
            self.refresh()  # once, as every step does: the first one must not wait for its launch
            self._report.fill("results fresh", self._fresh, self._fresh)
        self.begun = True
        return seeds

    def check_begun(self) -> None:
        """Make sure that there is something to step.

        Raises:
            CoopenvError: nothing has been reset.
        """
        if not self.begun:
            raise CoopenvError("step() called before reset()")

    def load(self) -> None:
        """Load all kernels, compiling those that this machine has not compiled yet; nothing moves."""
        (self.plugins or self.world).load()
        self._report.end_episodes()
        self._report.fill("load", self._nowhere, self._nowhere)

    def step(self, actions: np.ndarray | None = None, ticks: int | None = None) -> None:
        """Advance by one decision (or `ticks` camera ticks) under actions (W, N, A) in [-1, 1]."""
        if actions is not None:
            self.set_actions(actions)
        (self.plugins or self.world).advance(self.world.model.ticks_per_decision if ticks is None else ticks)
        self._report.end_episodes()
        self.refresh()
        self._report.reward_anew(self._nowhere)

    def step_or_restart(self) -> None:
        """Restart the worlds that are over, advance the others by one decision; nothing leaves the device."""
        if self.world.device == "cpu" and not self.view("over").any():  # a look costs nothing here, a launch does
            self.step()
            return
        wp.copy(self.world.mask, self.results.over)
        (self.plugins or self.world).advance(self.world.model.ticks_per_decision)
        self._restart()
        self._report.end_episodes()
        self._report.fill("results some fresh", self.world.mask, self._everywhere)
        self._report.reward_anew(self.world.mask)
        self.world.mask.zero_()

    def restart_finished(self) -> None:
        """Restart the worlds that are over and fill their results anew; nothing leaves the device."""
        wp.copy(self.world.mask, self.results.over)
        wp.copy(self._fresh, self.results.over)
        self._restart()
        self.world.mask.zero_()
        self._report.fill("results fresh", self._fresh, self._fresh)

    def _restart(self) -> None:
        self.world.restart()
        if self.plugins is not None:
            self.plugins.start(np.flatnonzero(self.world.mask.numpy()))

    def set_actions(self, actions: np.ndarray) -> None:
        """Copy host actions, (W, N, A), to the device."""
        if self.world.device == "cpu":
            self.view("actions")[...] = actions
        else:
            self.world.actions.assign(np.ascontiguousarray(actions, dtype=self.world.precision.numpy))

    def refresh(self) -> None:
        """Recompute the step results of every world from the present state."""
        self._report.fill("results", self._nowhere, self._everywhere)

    def view(self, name: str) -> np.ndarray:
        """Return a field of the results, the state or the actions on the host."""
        view = self._views.get(name)
        if view is None:
            view = self.array(name).numpy()
            if self.world.device == "cpu":
                self._views[name] = view
        return view

    def array(self, name: str) -> Any:
        """Return the Warp array of a field of the step results or the state, or the actions."""
        if name == "actions":
            return self.world.actions
        return getattr(self.world.state if name in self._state_fields else self.results, name)

    @contextmanager
    def stopping(self) -> Iterator[None]:
        """Stop the backend's vehicles when something goes wrong meanwhile."""
        try:
            yield
        except BaseException as error:
            self.backend.stop(error_text(error))
            raise

    def close(self) -> None:
        """Stop and close the backend, and end the threads."""
        self.backend.close()
        self.world.launch.close()

    def get_state(self) -> dict[str, Any]:
        """Return a copy of everything that the next step depends on.

        Raises:
            CoopenvError: a plug-in observer cannot be copied.
        """
        memory = {name: getattr(self.results, name).numpy().copy() for name in MEMORY}
        own = {} if self.plugins is None else {"observers": self.plugins.get_state()}
        return {**self.world.get_state(), **self.world.source_state(), **memory, **own}

    def set_state(self, values: Mapping[str, Any]) -> None:
        """Restore what `get_state` returned.

        Raises:
            CoopenvError: a field is missing, or does not hold what it may; nothing has changed then.
        """
        memory = {name: getattr(self.results, name) for name in MEMORY}
        checked = self.world.checked_state(values, memory, MEMORY)
        self.world.set_source_state(values)
        if self.plugins is not None:
            self.plugins.set_state(values.get("observers"), has_begun(checked["start_rotation"]))
        overwrite(self.world.state_arrays(), checked)
        self.refresh()
        overwrite(memory, checked)
        self.begun = bool(has_begun(self.view("start_rotation")).all())
