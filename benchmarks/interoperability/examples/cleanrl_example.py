"""CleanRL: the chain of wrappers of `ppo_continuous_action.py`, on a vector of environments."""

# /// script
# dependencies = ["coopenv"]
# [tool.coopenv]
# package = "gymnasium"
# documentation = "https://docs.cleanrl.dev/rl-algorithms/ppo/#ppo_continuous_actionpy"
# ///

import gymnasium
import numpy as np

import coopenv

gymnasium.register_envs(coopenv)


def make_env(number: int) -> gymnasium.Env:
    """Return an environment below CleanRL's wrappers."""
    env = gymnasium.make("coopenv/OpenSquare-v0")
    env = gymnasium.wrappers.FlattenObservation(env)
    env = gymnasium.wrappers.RecordEpisodeStatistics(env)
    env = gymnasium.wrappers.ClipAction(env)
    env = gymnasium.wrappers.NormalizeObservation(env)
    env = gymnasium.wrappers.TransformObservation(env, lambda values: np.clip(values, -10, 10), env.observation_space)
    env = gymnasium.wrappers.NormalizeReward(env, gamma=0.99)
    env = gymnasium.wrappers.TransformReward(env, lambda reward: np.clip(reward, -10, 10))
    env.action_space.seed(number)
    return env


envs = gymnasium.vector.SyncVectorEnv([lambda number=number: make_env(number) for number in range(2)])
observations, _ = envs.reset(seed=1)
envs.action_space.seed(0)
episodes = 0
for _ in range(1_000):
    observations, rewards, terminations, truncations, infos = envs.step(envs.action_space.sample())
    episodes += int(np.sum(infos.get("_episode", 0)))
assert observations.shape == envs.observation_space.shape and np.isfinite(observations).all()
assert episodes
print(f"{episodes} episodes with statistics in 1,000 steps of 2 environments")
