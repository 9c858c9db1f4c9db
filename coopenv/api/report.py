"""What a step results in, computed on the device: observations, reward terms, judgements."""

from collections.abc import Callable
from typing import Any

import numpy as np

from coopenv.api.reward import RewardFunction, Step, check_function, reward_of
from coopenv.api.terms.layout import Layout
from coopenv.api.terms.own import OwnTerms
from coopenv.api.terms.results import results_struct, results_table, step_results
from coopenv.base.errors import check_memory
from coopenv.scenario import Scenario
from coopenv.world.launch import PerWorld
from coopenv.world.precision import device_memory
from coopenv.world.records import allocate, size_of
from coopenv.world.world import World


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
