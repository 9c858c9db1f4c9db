"""The batched core under every interface: worlds plus step results, with constant Python work per step.

The results of a step (observations, reward terms, judgements) are computed on the device. Observers in Python
(`PlugIns`) run on the host in place of the embedded one: the world advances tick by tick, observers run in between.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from coopenv.api.arguments import RewardFunction, Step, check_function, reward_of
from coopenv.api.host_observers import PlugIns
from coopenv.api.terms.layout import observation_layout
from coopenv.api.terms.own import OwnTerms
from coopenv.api.terms.results import MEMORY, results_struct, results_table, step_results, team_results
from coopenv.base.errors import CoopenvError, check_memory, error_text
from coopenv.base.installation import load_reference
from coopenv.base.seeds import training_seed, world_keys
from coopenv.episode import Frame
from coopenv.scenario import Scenario
from coopenv.sources.base import Backend
from coopenv.sources.sources import simulation_of
from coopenv.sources.tick_world import open_world
from coopenv.world.embedded import HOST
from coopenv.world.launch import PerWorld
from coopenv.world.model import device_memory
from coopenv.world.state import allocate, has_begun, overwrite, size_of
from coopenv.world.world import Keys

if TYPE_CHECKING:
    from coopenv.viz.topview import TopView


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
            scenario: scenario of all worlds.
            worlds: number of worlds.
            dtype: "float32" or "float64".
            device: "cpu" or a CUDA device.
            threads: shares of the batch on the CPU.
            backend: source of ticks (None: simulated).
            reward: in place of the scenario's weighted sums, before a team's; on the CPU only.

        Raises:
            CoopenvError: also where a term does not exist or fails, or the results would not fit into memory.
        """
        self.backend: Backend = backend or simulation_of(scenario)
        self.world = open_world(self.backend, worlds, dtype, device, threads)
        on_host = self.world.observer is HOST
        self.plugins = PlugIns(scenario.observer.name, self.world) if on_host else None
        """The observers that run on the host; None where the embedded one estimates."""
        if on_host and (scenario.action.radio or scenario.reward.by_name["radio"]):
            raise CoopenvError(
                f"action.radio and reward.weights.radio: observer '{scenario.observer.name}' runs on the "
                "host; use riccati, robust or dead_reckoning"
            )
        self.layout = observation_layout(scenario)
        self.reward_terms = tuple(scenario.reward.by_name)
        """Names of the reward terms, in the order of the field `terms`."""
        self._views: dict[str, np.ndarray] = {}
        worlds, device, results = self.world.worlds, self.world.device, results_struct(self.world.precision)
        sizes = {"W": worlds, "N": self.world.model.vehicles, "D": self.layout.size, "K": len(self.reward_terms)}
        check_memory(size_of(results, sizes), f"results of {worlds} worlds", device_memory(device))
        self.results = allocate(results, sizes, device)
        self._own_terms = OwnTerms(scenario, self.world, self.layout, self.results)
        check_function(reward, device)
        self._reward, self._step = reward, Step(self.view, scenario)
        self._team = scenario.reward.team
        self._table = results_table(scenario, self.layout, device)
        flags: list[Any] = [wp.full(worlds, value, dtype=wp.int32, device=device) for value in (1, 0, 0)]
        self._everywhere, self._nowhere, self._fresh = flags
        scripted = load_reference("coopenv.policies.loader:ScriptedVehicles")  # policies stand on environments
        recorded = self.backend.capabilities.recorded
        self.scripted: Any = scripted(scenario) if any(scenario.drivers) and not recorded else None
        """Drivers in place of actions; None without any, and of a record, which must name no code."""
        self.begun = False
        """True after every world has been reset, or restored from a state that followed a reset."""

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
        self._start_on_host(chosen)
        self._fresh.assign(chosen.astype(np.int32))
        self._fill("results fresh", self._fresh, self._fresh)
        if self.backend.capabilities.real_time and not self.begun:
            self.refresh()  # once, as every step does: the first one must not wait for its launch
            self._fill("results fresh", self._fresh, self._fresh)
        self.begun = True
        return seeds

    def check_begun(self, call: str) -> None:
        """Make sure that there is an episode that a call of this name can act on.

        Raises:
            CoopenvError: nothing has been reset.
        """
        if not self.begun:
            raise CoopenvError(f"{call}() called before reset()")

    def load(self) -> None:
        """Load all kernels, compiling the missing ones; nothing moves."""
        (self.plugins or self.world).load()
        self._own_terms.end_episodes()
        self._fill("load", self._nowhere, self._nowhere)

    def step(self, actions: np.ndarray | None = None, ticks: int | None = None) -> None:
        """Advance by one decision (or `ticks` camera ticks) under actions (W, N, A) in [-1, 1]."""
        if actions is not None:
            self.set_actions(actions)
        self._drive_scripted()
        (self.plugins or self.world).advance(self.world.model.ticks_per_decision if ticks is None else ticks)
        self._own_terms.end_episodes()
        self._fill("results", self._nowhere, self._everywhere, stepped=True)

    def step_or_restart(self) -> None:
        """Restart the worlds that are over, advance the others by one decision; nothing leaves the device."""
        if self.world.device == "cpu" and not self.view("over").any():  # a look costs nothing here, a launch does
            self.step()
            return
        wp.copy(self.world.mask, self.results.over)
        self._drive_scripted()
        (self.plugins or self.world).advance(self.world.model.ticks_per_decision)
        self._restart()
        self._own_terms.end_episodes()
        self._fill("results some fresh", self.world.mask, self._everywhere, stepped=True)
        self.world.mask.zero_()

    def restart_finished(self) -> None:
        """Restart the worlds that are over and fill their results anew; nothing leaves the device."""
        wp.copy(self.world.mask, self.results.over)
        wp.copy(self._fresh, self.results.over)
        self._restart()
        self.world.mask.zero_()
        self._fill("results fresh", self._fresh, self._fresh)

    def _restart(self) -> None:
        self.world.restart()
        if self.plugins is not None or self.scripted is not None:
            self._start_on_host(self.world.mask.numpy() != 0)

    def _start_on_host(self, chosen: np.ndarray) -> None:
        """Start the observers and scripted drivers on the host in worlds (W,) that have just been reset."""
        if self.plugins is not None:
            self.plugins.start(np.flatnonzero(chosen))
        if self.scripted is not None:
            self.scripted.restart(chosen, self.world.model.vehicles)

    def _drive_scripted(self) -> None:
        """At a decision, let the drivers that the scenario names choose the actions of their vehicles."""
        if self.scripted is not None:
            ticks = self.view("tick")[self.view("over") == 0]
            if not (ticks % self.world.model.ticks_per_decision).any():
                actions = np.array(self.view("actions"))
                self.scripted.act(self.view("observation"), actions)
                self.set_actions(actions)

    def _fill(self, key: str, fresh: Any, chosen: Any, stepped: bool = False) -> None:
        """Compute the results of the worlds in `chosen` (W,); in the worlds of `fresh` (W,) an episode has just begun.

        After a step, the reward of a function in Python, if there is one, is each vehicle's own; 0 in fresh worlds.
        """
        world = self.world
        parts = [PerWorld(part) for part in (self._own_terms.records, self.results, fresh, chosen)]
        arguments = [world.model, PerWorld(world.state), self._table, *parts]
        world.launch.by_vehicle(key, step_results, arguments, world.model.vehicles)
        self._own_terms.fill(key, fresh, chosen)
        if stepped and self._reward is not None:
            earning = self.view("alive") & (fresh.numpy()[:, None] == 0)
            self.view("reward")[...] = reward_of(self._reward, self._step, earning)
        if self._team != "own":
            least = int(self._team == "min")
            share = self.backend.scenario.reward.own_share
            arguments = [world.model, PerWorld(world.state), PerWorld(self.results), least, share, PerWorld(chosen)]
            world.launch(f"{key} of the team", team_results, arguments)
        if world.device == "cpu":  # reading from a GPU would wait for it
            self._own_terms.check(self.view)

    def set_actions(self, actions: np.ndarray) -> None:
        """Copy host actions, (W, N, A), to the device."""
        if self.world.device == "cpu":
            self.view("actions")[...] = actions
        else:
            self.world.actions.assign(np.ascontiguousarray(actions, dtype=self.world.precision.numpy))

    def refresh(self) -> None:
        """Recompute the step results of every world from the present state."""
        self._fill("results", self._nowhere, self._everywhere)

    def view(self, name: str) -> np.ndarray:
        """Return a field of the results, the state or the actions on the host."""
        view = self._views.get(name)
        if view is None:
            if not hasattr(self.results, name) and name != "actions":
                return self.world.view(name)
            view = self.array(name).numpy()
            if self.world.device == "cpu":
                self._views[name] = view
        return view

    def array(self, name: str) -> Any:
        """Return the Warp array of a field of the step results, or else of the state, or the actions."""
        if name == "actions":
            return self.world.actions
        return getattr(self.results if hasattr(self.results, name) else self.world.state, name)

    @contextmanager
    def stopping(self) -> Iterator[None]:
        """Stop the backend's vehicles when something goes wrong meanwhile."""
        try:
            yield
        except BaseException as error:
            self.backend.stop(error_text(error))
            raise

    @cached_property
    def top_view(self) -> TopView:
        """The renderer of the top view; matplotlib is loaded with the first picture."""
        from coopenv.viz.topview import TopView

        return TopView(self.backend.scenario)

    def picture(self, world: int = 0) -> np.ndarray:
        """Return an (H, W, 3) uint8 picture of a world."""
        return self.top_view.paint(Frame.of(self, world))

    def close(self) -> None:
        """Stop and close the backend, end the threads, and close the window, if there is one."""
        self.backend.close()
        self.world.launch.close()
        if "top_view" in vars(self):
            self.top_view.close()
            del self.top_view

    def get_state(self) -> dict[str, Any]:
        """Return a copy of everything that the next step depends on.

        Raises:
            CoopenvError: a plug-in observer cannot be copied.
        """
        memory = {name: getattr(self.results, name).numpy().copy() for name in MEMORY}
        own: dict[str, Any] = {} if self.plugins is None else {"observers": self.plugins.get_state()}
        own |= {} if self.scripted is None else {"drivers": self.scripted.get_state()}
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
        if self.scripted is not None:
            self.scripted.set_state(values.get("drivers"))
        overwrite(self.world.state_arrays(), checked)
        self.refresh()
        overwrite(memory, checked)
        self.begun = bool(has_begun(self.view("start_rotation")).all())
