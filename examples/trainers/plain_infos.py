"""Infos of numbers alone, for libraries that keep or stack them; copy this file beside your program."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from pettingzoo.utils import BaseParallelWrapper

from coopenv.api.parallel_env import CooperativeLocalisationEnv

NUMBERS = ("position_error", "orientation_error", "nees", "arrived", "collided")
"""Keys of every info of `PlainInfos`: m, deg, squared normalised error, and 1.0 in the step of that event."""


class PlainInfos(BaseParallelWrapper[str, Any, np.ndarray]):
    """Keeps the numbers of each info, and drops the actions of vehicles that have ended.

    RLlib keeps infos for whole episodes; other libraries make tensors of them, and send actions for all agents. Truth
    is left out, so that no policy can be built on it by accident.
    """

    def __init__(self, env: CooperativeLocalisationEnv) -> None:
        """Wrap a world."""
        super().__init__(env)
        self.state_space = env.state_space

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Reset the world."""
        observations, infos = self.env.reset(seed=seed, options=options)
        return observations, self._numbers(infos)

    def step(self, actions: dict[str, np.ndarray]) -> Any:
        """Step the world."""
        living = {agent: actions[agent] for agent in self.env.agents if agent in actions}
        *results, infos = self.env.step(living)
        return *results, self._numbers(infos)

    def _numbers(self, infos: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, float]]:
        return {
            agent: {name: float(info[name] if name in info else info["outcome"] == name) for name in NUMBERS}
            for agent, info in infos.items()
        }
