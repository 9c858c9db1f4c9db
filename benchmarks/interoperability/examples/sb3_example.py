"""Stable-Baselines3: A2C of its quickstart, then PPO on the same environment."""

# /// script
# dependencies = ["coopenv", "stable-baselines3>=2.7", "torch"]
# [tool.coopenv]
# package = "stable-baselines3"
# documentation = "https://stable-baselines3.readthedocs.io/en/master/guide/quickstart.html"
# ///

import gymnasium
from stable_baselines3 import A2C, PPO

import coopenv

gymnasium.register_envs(coopenv)
env = gymnasium.make("coopenv/OpenSquare-v0", render_mode="rgb_array")
for algorithm in (A2C, PPO):
    model = algorithm("MlpPolicy", env, device="cpu", seed=0)
    model.learn(total_timesteps=2_048)
    vec_env = model.get_env()
    observation = vec_env.reset()
    for _ in range(100):
        action, _state = model.predict(observation, deterministic=True)
        observation, reward, done, info = vec_env.step(action)
assert vec_env.render().ndim == 3
print("A2C and PPO learn, predict and render")
