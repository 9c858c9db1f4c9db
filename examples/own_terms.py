"""A reward, a field of the observation and an end of episodes of one's own, without a change to coopenv.

Run: python examples/own_terms.py (about 20 s). The same by a file beside a scenario: examples/lane_keeping.
"""

import numpy as np
import warp as wp

import coopenv


def smooth(ego):  # of what the vehicle knows; Warp compiles it
    """Minus the squared steering angle, rad^2."""
    return -ego.command[1] * ego.command[1]


def lost(ego, truth):  # the truth as well, so the scenario has to declare it
    """True if the position error exceeds a metre."""
    return truth.position_error > 1.0


def ahead(ego, target):  # one value for every landmark and vehicle
    """Cosine of the angle between the optical axis and the target."""
    return wp.where(target.in_view, target.bearing[2], 0.0)


coopenv.register_reward("smooth", smooth, unit="rad^2")
coopenv.register_termination("lost", lost)
coopenv.register_observation("ahead", ahead, per="target")

OVERRIDES = {
    "reward.weights.smooth": 0.5,
    "observation.include": ["estimate", "goal", "ahead"],
    "termination.lost": True,
    "termination.privileged": True,
}
env = coopenv.parallel_env("urban_crossing", overrides=OVERRIDES)
observations, infos = env.reset(seed=0)
for _ in range(20):
    actions = {agent: env.action_space(agent).sample() for agent in env.agents}
    observations, rewards, terminated, truncated, infos = env.step(actions)
for agent, info in infos.items():
    seen = observations[agent][env.observation_layout["ahead"].slice]
    print(f"{agent}: smooth {info['reward_terms']['smooth']:6.3f}, {info['outcome']}, ahead {seen.round(2)}")


def near_and_sure(step):  # without kernels: all vehicles of all worlds at once, (worlds, vehicles)
    return step["reward_terms"]["progress"] - 0.1 * step["position_error"] + 10.0 * (step["ended"] == 1)


envs = coopenv.make_vec("urban_crossing", num_worlds=64, reward=near_and_sure)
envs.reset(seed=0)
total = sum(envs.step(np.zeros(envs.action_space.shape))[1] for _ in range(50))
print(f"five seconds straight on: a mean return of {total.mean():.2f} per vehicle")
