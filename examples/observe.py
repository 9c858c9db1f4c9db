"""Step an environment in a loop and watch one vehicle find out where it is.

Run: python examples/observe.py (about 10 s)
"""

import numpy as np

import coopenv

env = coopenv.parallel_env("busy_intersection", dtype="float64", overrides={"noise.enabled": False})
observations, infos = env.reset(seed=0)
still = np.zeros(2, dtype=np.float32)  # the paper's vehicles have prescribed motion and ignore actions

print(f"{'time':>6} {'error':>12} {'angle':>12}   in view")
while env.agents:
    observations, rewards, terminated, truncated, infos = env.step(dict.fromkeys(env.agents, still))
    info = infos["vehicle_1"]
    if round(info["time"] * 10) % 50 == 0:
        error, angle = info["position_error"], info["orientation_error"]
        print(f"{info['time']:5.1f}s {error:10.2e} m {angle:8.2e} deg   {', '.join(info['visible'])}")
