"""A world for trainers that put infos into arrays: numbers only, no truth, and no complaint about the dead."""

from typing import Any

import numpy as np
from gymnasium.spaces import flatdim, unflatten
from pettingzoo.utils import BaseParallelWrapper

from coopenv.api.parallel_env import CooperativeLocalisationEnv

NUMBERS = ("position_error", "orientation_error", "nees", "arrived", "collided")
"""Keys of every info: m, deg, squared normalised error, and 1.0 in the step of that event."""


class PlainInfos(BaseParallelWrapper[str, Any, np.ndarray]):
    """Keeps what is a number of each info, and drops the actions of vehicles that have ended.

    TorchRL makes a tensor of every entry of an info, and sends actions for all agents, the dead ones included. RLlib
    keeps infos for whole episodes. Truth is left out, so that no policy can be built on it by accident.
    """

    def __init__(self, env: CooperativeLocalisationEnv, with_absent: bool = False) -> None:
        """Wrap a world.

        Args:
            env: the world.
            with_absent: whether a reset also returns zeros for vehicles that are absent in the episode, which are in
                `possible_agents` and not in `agents`. TorchRL's wrapper asks for them.
        """
        super().__init__(env)
        self.state_space = env.state_space
        self.with_absent = with_absent

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        observations, infos = self.env.reset(seed=seed, options=options)
        infos = {agent: plain(info) for agent, info in infos.items()}
        for agent in self.possible_agents if self.with_absent else ():
            if agent not in infos:
                space = self.observation_space(agent)
                observations[agent] = unflatten(space, np.zeros(flatdim(space), dtype=np.float32))
                infos[agent] = dict.fromkeys(NUMBERS, 0.0)
        return observations, infos

    def step(self, actions: dict[str, np.ndarray]) -> Any:
        living = {agent: actions[agent] for agent in self.env.agents if agent in actions}
        *results, infos = self.env.step(living)
        return *results, {agent: plain(info) for agent, info in infos.items()}


def plain(info: dict[str, Any]) -> dict[str, float]:
    """Return the numbers of an info."""
    events = {"arrived": float(info["outcome"] == "arrived"), "collided": float(info["outcome"] == "collided")}
    return {name: events[name] if name in events else float(info[name]) for name in NUMBERS}
