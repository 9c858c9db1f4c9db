"""RLlib, new API stack: one world as a `MultiAgentEnv`, or a batch as rows for one policy. Needs the extra `rllib`.

Copy this file, plain_infos.py and true_ends.py beside your program; docs/trainers.md has one.
"""

from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import VectorWrapper
from plain_infos import PlainInfos
from true_ends import TrueEnds

from coopenv.api.make import make_rows, parallel_env
from coopenv.base.errors import CoopenvError
from coopenv.base.installation import install_command

try:
    from ray.rllib.env.multi_agent_env import MultiAgentEnv
except ImportError as error:
    raise ImportError(f"{__name__} needs RLlib: {install_command('rllib')}") from error


class CooperativeMultiAgentEnv(MultiAgentEnv):
    """One world as an RLlib `MultiAgentEnv`.

    Differs from RLlib's `ParallelPettingZooEnv` in what it says at the horizon: `truncateds["__all__"]`, and nothing of
    single vehicles. An episode whose agents are all flagged, be it as truncated, counts as terminated in RLlib (2.60):
    the time limit would be learnt as a death. Vehicles that arrive or collide are flagged, in that step too.
    """

    def __init__(self, config: dict[str, Any] | None = None) -> None:
        """Build the world.

        Args:
            config: `env`: name or TOML file; the other entries are options of `coopenv.parallel_env`.
        """
        options = dict(config or {})
        self.env = PlainInfos(parallel_env(options.pop("env", "urban_crossing"), **options))
        self.possible_agents = list(self.env.possible_agents)
        self.agents = list(self.possible_agents)
        self.observation_spaces = {agent: self.env.observation_space(agent) for agent in self.possible_agents}
        self.action_spaces = {agent: self.env.action_space(agent) for agent in self.possible_agents}
        self.observation_space = spaces.Dict(self.observation_spaces)
        self.action_space = spaces.Dict(self.action_spaces)
        self.render_mode = self.env.unwrapped.render_mode
        super().__init__()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, Any]:
        observations, infos = self.env.reset(seed=seed, options=options)
        self.agents = list(self.env.agents)
        return observations, infos

    def step(self, action_dict: dict[str, np.ndarray]) -> tuple[Any, Any, Any, Any, Any]:
        observations, rewards, terminated, truncated, infos = self.env.step(action_dict)
        self.agents = list(self.env.agents)
        horizon = any(truncated.values())
        over = {**terminated, "__all__": not self.agents and not horizon}
        return observations, rewards, over, {"__all__": horizon}, infos

    def render(self) -> Any:
        return self.env.render()

    def close(self) -> None:
        self.env.close()


class CooperativeRows(VectorWrapper):
    """A batch as a vector environment of RLlib: rows (world, acting vehicle) for one policy that they share.

        config = (
            PPOConfig()
            .environment(CooperativeRows, env_config={"env": "urban_crossing"})
            .env_runners(num_envs_per_env_runner=256, gym_env_vectorize_mode="vector_entry_point")
        )

    An episode is a vehicle's, see `TrueEnds`. There are no infos: RLlib would keep them of every step.
    """

    def __init__(self, config: dict[str, Any]) -> None:
        """Build the batch.

        Args:
            config: `env`: name or TOML file; `num_envs`: rows, a multiple of the acting vehicles, given by RLlib; the
                other entries are options of `coopenv.make_vec`.

        Raises:
            CoopenvError: RLlib was not asked for one vector environment.
        """
        options = dict(config)
        if "num_envs" not in options:
            raise CoopenvError("CooperativeRows needs env_runners(gym_env_vectorize_mode='vector_entry_point')")
        super().__init__(TrueEnds(make_rows(options.pop("env", "urban_crossing"), acting=True, **options)))

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        return self.env.reset(seed=seed, options=options)[0], {}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        return *self.env.step(actions)[:4], {}
