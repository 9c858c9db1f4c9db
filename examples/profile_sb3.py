"""Train Stable-Baselines3's PPO on 256 rows and see what share of its time the environment takes.

Needs the extra `train`. Run: python examples/profile_sb3.py
"""

from pathlib import Path
from time import perf_counter

import torch
from stable_baselines3 import PPO

import coopenv
from coopenv.api.trainers.sb3 import CooperativeSB3VecEnv

torch.set_num_threads(1)


class TimedEnv(CooperativeSB3VecEnv):
    """The batch, with a stopwatch around its steps."""

    seconds = 0.0

    def step_wait(self):  # type: ignore[no-untyped-def]
        """Step, and add up the time."""
        start = perf_counter()
        result = super().step_wait()
        self.seconds += perf_counter() - start
        return result


env = TimedEnv(coopenv.make_vec(Path(__file__).with_name("four_way.toml"), num_worlds=64, autoreset="same_step"))
model = PPO("MlpPolicy", env, n_steps=64, seed=0, device="cpu")
model.learn(2 * 64 * env.num_envs)  # compile and warm up
env.seconds, start = 0.0, perf_counter()
model.learn(3 * 64 * env.num_envs, reset_num_timesteps=False)
wall = perf_counter() - start
print(f"{env.num_envs} rows: environment {env.seconds:.2f} s of {wall:.2f} s = {100 * env.seconds / wall:.1f} %")
