"""RLlib, several agents: `CooperativeMultiAgentEnv` in place of the wrapper of its page on PettingZoo."""

# /// script
# dependencies = ["coopenv", "ray[rllib]>=2.50", "torch"]
# [tool.coopenv]
# package = "ray"
# documentation = "https://docs.ray.io/en/latest/rllib/multi-agent-envs.html"
# needs = ["examples/trainers/rllib_env.py"]
# ///

from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModuleSpec
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from rllib_env import CooperativeMultiAgentEnv

config = (
    PPOConfig()
    .environment(CooperativeMultiAgentEnv, env_config={"env": "take_turns"})
    .env_runners(num_env_runners=0)
    .multi_agent(policies={"shared"}, policy_mapping_fn=lambda agent, episode, **_: "shared")
    .rl_module(rl_module_spec=MultiRLModuleSpec(rl_module_specs={"shared": RLModuleSpec()}))
    .training(train_batch_size_per_learner=512, minibatch_size=128, num_epochs=1)
)
algorithm = config.build_algo()
result = algorithm.train()
algorithm.stop()
decisions = result["env_runners"]["num_agent_steps_sampled_lifetime"]
print(f"PPO with one policy: {sum(decisions.values()):.0f} decisions of {len(decisions)} vehicles")
