"""Episodes of a batch that are summed up step by step."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

import coopenv


def first_episodes(
    env: coopenv.CooperativeVectorEnv, seed: int, decisions: int, policy: Callable[[np.ndarray], np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return return, decisions and outcome of every vehicle's first episode; `env` is not reset automatically."""
    observation, _ = env.reset(seed=seed)
    returned, length, under_way = np.zeros(env.num_envs), np.zeros(env.num_envs), np.ones(env.num_envs, bool)
    for _ in range(decisions):
        observation, reward, terminated, truncated, infos = env.step(policy(observation))
        returned += np.where(under_way, reward, 0.0)
        length += under_way
        under_way &= ~(terminated | truncated)
    return returned, length, infos["ended"]
