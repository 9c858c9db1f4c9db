"""TorchRL: `PettingZooWrapper` of its reference, and `GymEnv`, each with its check of specs and a rollout."""

# /// script
# dependencies = ["coopenv", "torchrl>=0.11", "torch"]
# [tool.coopenv]
# package = "torchrl"
# documentation = "https://docs.pytorch.org/rl/stable/reference/generated/torchrl.envs.PettingZooWrapper.html"
# ///

from torchrl.envs.libs.gym import GymEnv
from torchrl.envs.libs.pettingzoo import PettingZooWrapper
from torchrl.envs.utils import check_env_specs

import coopenv

single = GymEnv("coopenv/OpenSquare-v0")
check_env_specs(single)
env = PettingZooWrapper(env=coopenv.parallel_env("take_turns"), return_state=True, group_map=None, use_mask=True)
check_env_specs(env)
rollout = env.rollout(10)
print(f"check_env_specs passed twice; a rollout of {len(rollout)} steps, groups {[*env.group_map]}")
