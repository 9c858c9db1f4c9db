"""Write an observer of one's own, compare it with others on the same ticks, and let it drive an environment.

Run: python examples/own_observer.py (about 45 s)
"""

import numpy as np

from coopenv import load_scenario, parallel_env
from coopenv.observers import Estimate, Message, Setup, Tick, register, run
from coopenv.runs.recorder import record


class Complementary:
    """Odometry, pulled towards where the bearings' lines meet and turned towards where they point."""

    def __init__(self, setup: Setup) -> None:
        self.marker = setup.marker

    def reset(self, initial_pose: tuple[np.ndarray, np.ndarray], initial_covariance: np.ndarray) -> None:
        self.R, self.p = initial_pose

    def update(self, tick: Tick) -> Estimate:
        self.p = self.p + self.R @ tick.translation
        self.R = self.R @ tick.rotation
        A, y, turn = 1e-3 * np.eye(3), 1e-3 * self.p, np.zeros(3)
        camera = self.R @ tick.lever_arm
        for _, bearing, position, _ in tick.usable():  # landmarks, and neighbours that have been heard
            b = self.R @ bearing
            across = np.eye(3) - np.outer(b, b)
            A += across
            y += across @ (position - camera)
            line = position - camera - self.p
            turn += np.cross(b, line / np.linalg.norm(line))
        self.p = self.p + 0.5 * tick.dt * (np.linalg.solve(A, y) - self.p)
        S = np.cross(np.eye(3), 5.0 * tick.dt * turn)  # S x = turn x x
        self.R = np.linalg.solve(np.eye(3) - S / 2, np.eye(3) + S / 2) @ self.R  # a rotation (Cayley)
        return Estimate(self.R, self.p)

    def message(self) -> Message:
        return Message(position=self.p + self.R @ self.marker)


register("complementary", Complementary)
recording = record(load_scenario("busy_intersection"), seed=0)
print(f"{'observer':16}  position error of the five vehicles at the end [m]      bytes/s")
for name in ("complementary", "riccati", "dead_reckoning"):
    result = run(name, recording)
    errors = "  ".join(f"{e:8.3f}" for e in result.position_error[-1])
    print(f"{name:16} {errors}   {result.bytes_per_second[0]:8.0f}   {result.failure}")

env = parallel_env("busy_intersection", observer="complementary")  # the same class in the environment
_, infos = env.reset(seed=0)
while env.agents:
    _, _, _, _, infos = env.step({agent: env.action_space(agent).sample() for agent in env.agents})
print(f"{'in the environment':18}", *(f"{info['position_error']:8.3f}" for info in infos.values()))
