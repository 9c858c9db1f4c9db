"""SuperSuit: a vector of parallel environments for Stable-Baselines3, as in PettingZoo's tutorial."""

# /// script
# dependencies = ["coopenv", "supersuit>=3.9", "stable-baselines3>=2.7", "torch"]
# [tool.coopenv]
# package = "supersuit"
# documentation = "https://pettingzoo.farama.org/tutorials/sb3/waterworld/"
# ///

import supersuit
from stable_baselines3 import PPO
from stable_baselines3.ppo import MlpPolicy

import coopenv

env = coopenv.parallel_env("take_turns")
env = supersuit.black_death_v3(env)
env.reset(seed=0)
env = supersuit.pettingzoo_env_to_vec_env_v1(env)
env = supersuit.concat_vec_envs_v1(env, 2, num_cpus=1, base_class="stable_baselines3")
model = PPO(MlpPolicy, env, device="cpu", n_steps=256, batch_size=256)
model.learn(total_timesteps=2_048)
env.close()
print(f"PPO learns on {env.num_envs} rows (their time limit counts as an end: use make_sb3_vec_env)")
