"""Let a scripted driver cross the urban intersection, and see what each vehicle knows of itself.

Run: python examples/drive.py (about 10 s)
"""

import coopenv
from coopenv.policies import act, load_agent

env = coopenv.parallel_env("urban_crossing")
driver = load_agent("route_follower", env.scenario)
observations, infos = env.reset(seed=1)
total = dict.fromkeys(env.possible_agents, 0.0)
while env.agents:
    actions = act(driver, {agent: observations[agent] for agent in env.agents})
    observations, rewards, terminated, truncated, infos = env.step(actions)
    for agent, reward in rewards.items():
        total[agent] += reward
    for agent in infos:
        if terminated[agent] or truncated[agent]:
            info = infos[agent]
            print(
                f"{agent} {info['outcome']} after {info['time']:.1f} s, return {total[agent]:.1f}, "
                f"position error {100 * info['position_error']:.1f} cm"
            )
