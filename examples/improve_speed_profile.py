"""Improve a speed profile by gradient descent, so that the vehicles know better where they are when they arrive.

The distance that each vehicle is commanded to drive stays the same: only when it drives slowly and when fast changes.
Run: python examples/improve_speed_profile.py (about two minutes)
"""

from pathlib import Path

import numpy as np
from differentiable import DifferentiableWorld

import coopenv

overrides = {
    "noise.enabled": False,
    "camera.miss_probability": 0.0,
    "v2x": {"delay": 0, "loss": 0.0, "staleness": None},
    "vehicles.*.initial_estimate.position_radius": 0.01,
    "vehicles.*.initial_estimate.orientation_angle": 0.005,
}
world = DifferentiableWorld(coopenv.load_scenario(Path(__file__).with_name("four_way.toml"), overrides))
commands = np.zeros((20, 1, 4, 2))  # two seconds straight on at half of the top speed
best = world.rollout(commands)
start, step = best.uncertainty, 0.3
for iteration in range(40):
    slope = best.gradient.copy()
    slope[..., 1] = 0.0  # keep the steering straight
    slope -= slope.mean(axis=0)  # and the distance
    trial = np.clip(commands - step * slope / np.abs(slope).max(), -0.9, 0.9)
    result = world.rollout(trial)
    if result.uncertainty < best.uncertainty:
        commands, best = trial, result
    else:
        step /= 2
    if iteration % 10 == 0:
        print(f"iteration {iteration:2d}: sum of trace P = {best.uncertainty:.4f}")
print(f"{start:.4f} -> {best.uncertainty:.4f} ({100 * (best.uncertainty / start - 1):+.1f} %)")
