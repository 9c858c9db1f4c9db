"""What a step results in, computed on the device: observations, reward terms, judgements."""

from collections.abc import Callable, Collection
from typing import Any

import numpy as np
import warp as wp

from coopenv.api.reward import RewardFunction, Step, check_finite, check_function, reward_of
from coopenv.api.step_results import results_struct
from coopenv.api.terms.binding import bound_terms, own_places
from coopenv.api.terms.kernels import check_own_terms, endings_kernel, results_kernel
from coopenv.api.terms.layout import Layout
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
        weights = scenario.reward.by_name
        sizes = {"W": world.worlds, "N": world.model.vehicles, "D": layout.size, "K": len(weights)}
        needed = size_of(results_struct(p), sizes)
        check_memory(needed, f"results of {world.worlds} worlds", device_memory(world.device))
        self.results = allocate(results_struct(p), sizes, world.device)
        terms = bound_terms(scenario)
        check_own_terms(terms, world.device)
        self._own_terms = own_places(terms, layout)
        check_function(reward, world.device)
        self._reward, self._step = reward, Step(view, scenario)
        self._fill = results_kernel(terms, p)
        self._end = endings_kernel(terms.conditions, p) if terms.conditions else None
        fields = layout.values()
        self._vectors = [
            _vector(wp.int32, [field.start for field in fields]),
            _vector(wp.float32, [field.center for field in fields]),
            _vector(wp.float32, [1.0 / field.scale for field in fields]),
            _vector(wp.float32, weights.values()),
        ]

    def end_episodes(self) -> None:
        """End the episodes of vehicles that fulfil a condition of the scenario's own."""
        if self._end is not None:
            arguments = [self._world.model, PerWorld(self._world.state), PerWorld(self.results)]
            self._launch("end", self._end, arguments)

    def fill(self, key: str, fresh: Any, chosen: Any) -> None:
        """Compute the results of the worlds in `chosen` (W,); in those of `fresh` (W,) an episode has just begun."""
        fixed = [self._world.model, PerWorld(self._world.state), *self._vectors]
        changing = [PerWorld(part) for part in (self.results, fresh, chosen)]
        self._launch(key, self._fill, fixed + changing)
        if self._world.device == "cpu":  # to look at a GPU would mean to wait for it
            for title, name, place in self._own_terms:
                check_finite(title, self._view(name)[..., place])

    def _launch(self, key: str, kernel: Any, arguments: list[Any]) -> None:
        self._world.launch(key, kernel, arguments, inner=(self._world.model.vehicles,))

    def reward_anew(self, fresh: Any) -> None:
        """Replace the reward of the worlds that have not just been reset by that of a function in Python."""
        if self._reward is not None:
            earning = self._view("alive") & (fresh.numpy()[:, None] == 0)
            self._view("reward")[...] = reward_of(self._reward, self._step, earning)


def _vector(dtype: Any, values: Collection[float]) -> Any:
    """Return a Warp vector, which a kernel takes by value."""
    return wp.types.vector(length=len(values), dtype=dtype)(*values)
