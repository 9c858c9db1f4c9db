"""Extended Kalman filter over the stacked left errors of all vehicles: the upper reference.

Source: Roumeliotis and Bekey, Distributed multirobot localization, IEEE Transactions on Robotics and Automation 18(5),
2002, in its centralised form; errors and Jacobians as in mekf.py. A bearing from i to a point z_j = p_j + R_j m_j of
vehicle j also has H_j = B Rhat_i^T Rhat_j [-S(m_j), I] / |d|.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from coopenv.estimation.observers.base import Array, Estimate, Message, Setup, Tick
from coopenv.estimation.observers.mekf import LeftError, innovation, kalman, transition
from coopenv.estimation.observers.rotations import orthonormalise, skew


class Centralised:
    """Has every measurement of every vehicle at once; loss and delay of messages do not touch it."""

    joint = True

    def __init__(self, setups: Sequence[Setup]) -> None:
        """Take one setup per vehicle."""
        self.landmarks = setups[0].landmarks
        self.markers = [setup.marker for setup in setups]

    def reset(self, initial_poses: Sequence[tuple[Array, Array]], initial_covariances: Sequence[Array]) -> None:
        """Start with independent errors."""
        self.poses = [(np.array(R, float), np.array(p, float)) for R, p in initial_poses]
        self.P = np.zeros((6 * len(self.poses), 6 * len(self.poses)))
        for i, covariance in enumerate(initial_covariances):
            self.P[self.block(i), self.block(i)] = covariance
        self.sent = [Message() for _ in self.poses]

    @staticmethod
    def block(i: int) -> slice:
        """Return where vehicle i stands in the state."""
        return slice(6 * i, 6 * i + 6)

    def update(self, ticks: Sequence[Tick]) -> list[Estimate]:
        """Predict every vehicle, then correct by all bearings in one update."""
        self.predict(ticks)
        rows = [row for i, tick in enumerate(ticks) if tick.due for row in self.rows(i, tick)]
        if rows:
            H = np.concatenate([row[0] for row in rows])
            N = np.diag(np.concatenate([row[2] for row in rows]))
            dx, self.P, _ = kalman(self.P, H, N, np.concatenate([row[1] for row in rows]))
            self.move(dx)
        self.sent = [
            Message(
                extra={
                    "odometry": np.concatenate([tick.angular_velocity, tick.velocity]),
                    "bearings": tick.bearings[tick.valid],
                }
            )
            for tick in ticks
        ]
        return [
            LeftError(R, p, self.P[self.block(i), self.block(i)].copy()).estimate()
            for i, (R, p) in enumerate(self.poses)
        ]

    def predict(self, ticks: Sequence[Tick]) -> None:
        """Carry every pose and the joint covariance through one tick of odometry."""
        F = np.zeros_like(self.P)
        for i, (tick, (R, p)) in enumerate(zip(ticks, self.poses, strict=True)):
            F[self.block(i), self.block(i)] = transition(tick.rotation, tick.translation)
            self.poses[i] = orthonormalise(R @ tick.rotation), p + R @ tick.translation
        noise = np.concatenate([tick.noise.odometry(tick.dt) for tick in ticks])
        self.P = F @ self.P @ F.T + np.diag(noise)

    def rows(self, i: int, tick: Tick) -> list[tuple[Array, Array, Array]]:
        """Return (H (2, 6N), residual (2,), variances (2,)) of every bearing of vehicle i."""
        R, p = self.poses[i]
        own = LeftError(R, p, self.P)
        result = []
        for n in np.flatnonzero(tick.valid):
            j = int(tick.targets[n]) - self.landmarks
            if j < 0:
                z = tick.landmarks[int(tick.targets[n])]
            else:
                Rj, pj = self.poses[j]
                z = pj + Rj @ self.markers[j]
            residual, J = innovation(R, p, tick.lever_arm, tick.bearings[n : n + 1], z[None])
            H = np.zeros((2, len(self.P)))
            H[:, self.block(i)] = (J @ own.jacobian(z[None]))[0]
            if j >= 0:
                H[:, self.block(j)] = J[0] @ R.T @ Rj @ np.hstack([-skew(self.markers[j]), np.eye(3)])
            result.append((H, residual[0], np.full(2, tick.noise.bearing_std**2)))
        return result

    def move(self, dx: Array) -> None:
        """Move every pose by its part of the error."""
        for i, (R, p) in enumerate(self.poses):
            moved = LeftError(R, p, self.P).moved(dx[self.block(i)], self.P)
            self.poses[i] = moved.R, moved.p

    def messages(self) -> list[Message]:
        """Return the raw measurements of this tick: odometry and bearings."""
        return self.sent
