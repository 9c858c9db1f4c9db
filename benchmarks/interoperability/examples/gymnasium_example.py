"""Gymnasium: the loop of its basic usage, then its own check of environments."""

# /// script
# dependencies = ["coopenv"]
# [tool.coopenv]
# package = "gymnasium"
# documentation = "https://gymnasium.farama.org/introduction/basic_usage/"
# ///

import gymnasium
from gymnasium.utils.env_checker import check_env

import coopenv

gymnasium.register_envs(coopenv)
env = gymnasium.make("coopenv/OpenSquare-v0")
observation, info = env.reset(seed=42)
env.action_space.seed(0)
total, episode_over = 0.0, False
while not episode_over:
    observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
    total += float(reward)
    episode_over = terminated or truncated
check_env(gymnasium.make("coopenv/OpenSquare-v0").unwrapped)
print(f"an episode with return {total:.1f}; check_env passed")
env.close()
