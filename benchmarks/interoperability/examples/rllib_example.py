"""RLlib: PPO of its getting started, by the id of an environment."""

# /// script
# dependencies = ["coopenv", "ray[rllib]>=2.50", "torch"]
# [tool.coopenv]
# package = "ray"
# documentation = "https://docs.ray.io/en/latest/rllib/getting-started.html"
# ///

import gymnasium
from ray.rllib.algorithms.ppo import PPOConfig
from ray.tune.registry import register_env

import coopenv  # noqa: F401 (registers the id)

register_env("square", lambda config: gymnasium.make("coopenv/OpenSquare-v0"))
config = (
    PPOConfig()
    .environment("square")
    .env_runners(num_env_runners=0)
    .training(train_batch_size_per_learner=512, minibatch_size=128, num_epochs=1)
)
algorithm = config.build_algo()
result = algorithm.train()
algorithm.stop()
print(f"PPO: {result['env_runners']['num_env_steps_sampled_lifetime']:.0f} decisions")
