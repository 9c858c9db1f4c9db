"""PettingZoo: the random episode of its front page, then its own test of parallel environments."""

# /// script
# dependencies = ["coopenv"]
# [tool.coopenv]
# package = "pettingzoo"
# documentation = "https://pettingzoo.farama.org/api/parallel/"
# ///

from pettingzoo.test import parallel_api_test

import coopenv

env = coopenv.parallel_env("urban_crossing")
observations, infos = env.reset(seed=42)
for number, agent in enumerate(env.possible_agents):
    env.action_space(agent).seed(number)
steps = 0
while env.agents:
    actions = {agent: env.action_space(agent).sample() for agent in env.agents}
    observations, rewards, terminations, truncations, infos = env.step(actions)
    steps += 1
env.close()
parallel_api_test(coopenv.parallel_env("open_square"), num_cycles=100)
print(f"{steps} steps until all vehicles had ended; parallel_api_test passed")
