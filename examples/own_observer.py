"""Write an observer of one's own, compare it with others on the same ticks, and let it drive an environment.

Run: python examples/own_observer.py (about 45 s)
"""

import numpy as np

from coopenv import load_scenario, parallel_env
from coopenv.observers import Estimate, Message, Setup, Tick, register, run
from coopenv.runs.recorder import record

GATE = 13.8  # 0.999 quantile of a chi-square with two degrees of freedom


def cross_matrix(v: np.ndarray) -> np.ndarray:
    """Return S(v) with S(v) y = v x y."""
    return np.cross(np.eye(3), v)


class Ekf:
    """An extended Kalman filter of the pose, whose error in the map frame is R = Exp(theta) Rhat, p = phat + d."""

    def __init__(self, setup: Setup) -> None:
        self.marker, self.noise = setup.marker, setup.noise

    def reset(self, initial_pose: tuple[np.ndarray, np.ndarray], initial_covariance: np.ndarray) -> None:
        self.R, self.p = initial_pose
        turned = np.kron(np.eye(2), self.R)  # from body to map axes
        self.P = turned @ initial_covariance @ turned.T

    def update(self, tick: Tick) -> Estimate:
        step = self.R @ tick.translation
        F = np.eye(6)
        F[3:, :3] = -cross_matrix(step)
        self.R, self.p = self.R @ tick.rotation, self.p + step
        self.P = F @ self.P @ F.T + np.diag(self.noise.odometry(tick.dt))
        for _, bearing, position, message in tick.usable():  # landmarks, and neighbours whose message is at hand
            known = message is None or message.covariance is None
            # A neighbour's error hardly changes within a second, whose frames count as one.
            self.correct(tick, bearing, position, np.zeros((3, 3)) if known else message.covariance / tick.dt)
        turned = np.kron(np.eye(2), self.R.T)  # from map to body axes
        return Estimate(self.R, self.p, turned @ self.P @ turned.T)

    def correct(self, tick: Tick, bearing: np.ndarray, position: np.ndarray, covariance: np.ndarray) -> None:
        b, arm = self.R @ bearing, self.R @ tick.lever_arm
        line = position - self.p - arm
        distance = np.linalg.norm(line)
        u = line / distance
        across = (np.eye(3) - np.outer(u, u)) / distance
        H = np.hstack([-cross_matrix(b) - across @ cross_matrix(arm), across])
        # The second-order error of u, which H neglects, rad.
        curvature = np.trace(self.P[3:, 3:] + covariance) / distance**2
        S = H @ self.P @ H.T + (self.noise.bearing**2 + curvature**2) * np.eye(3) + across @ covariance @ across
        if (u - b) @ np.linalg.solve(S, u - b) > GATE:
            return
        K = np.linalg.solve(S, H @ self.P).T
        dx = K @ (u - b)
        turn = cross_matrix(dx[:3] / 2)
        self.R = np.linalg.solve(np.eye(3) - turn, np.eye(3) + turn) @ self.R  # a rotation (Cayley)
        self.p, self.P = self.p + dx[3:], self.P - K @ H @ self.P

    def message(self) -> Message:
        arm = self.R @ self.marker
        J = np.hstack([-cross_matrix(arm), np.eye(3)])
        return Message(position=self.p + arm, covariance=J @ self.P @ J.T)


if __name__ == "__main__":
    register("my_ekf", Ekf)
    recording = record(load_scenario("busy_intersection_tracking"), seed=0)
    print(f"{'observer':16}  position error of the five vehicles at the end [m]      bytes/s  largest [m]  ANEES")
    for name in ("my_ekf", "riccati", "dead_reckoning"):
        result = run(name, recording)
        errors = "  ".join(f"{e:8.3f}" for e in result.position_error[-1])
        rest = f"{result.position_error.max():8.2f} {result.anees().max():8.1f}"
        print(f"{name:16} {errors}   {result.bytes_per_second[0]:8.0f} {rest}   {result.failure}")

    env = parallel_env("busy_intersection_tracking", observer="my_ekf")  # the same class in the environment
    _, infos = env.reset(seed=0)
    while env.agents:
        _, _, _, _, infos = env.step({agent: env.action_space(agent).sample() for agent in env.agents})
    print(f"{'in the environment':18}", *(f"{info['position_error']:8.3f}" for info in infos.values()))
