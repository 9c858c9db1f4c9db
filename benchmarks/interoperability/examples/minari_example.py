"""Minari: the data set of its basic usage, collected, listed and loaded."""

# /// script
# dependencies = ["coopenv", "minari[create,hdf5]>=0.5.2"]
# [tool.coopenv]
# package = "minari"
# documentation = "https://minari.farama.org/content/basic_usage/"
# ///

import os
from pathlib import Path

os.environ["MINARI_DATASETS_PATH"] = str(Path("datasets").absolute())
import gymnasium
import minari

import coopenv

gymnasium.register_envs(coopenv)
env = minari.DataCollector(gymnasium.make("coopenv/OpenSquare-v0"))
for episode in range(3):
    env.reset(seed=episode)
    done = False
    while not done:
        observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
        done = terminated or truncated
name = "square/random-v0"
env.create_dataset(name, algorithm_name="random", author="coopenv", code_permalink="none", author_email="none@none.org")
dataset = minari.load_dataset(name)
again = dataset.recover_environment()
again.reset(seed=0)
print(f"{dataset.total_episodes} episodes, {dataset.total_steps} steps; the environment is recovered")
