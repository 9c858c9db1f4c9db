"""Extended Kalman filter over the stacked left errors of all vehicles: the upper reference.

Source: Roumeliotis and Bekey, Distributed multirobot localization, IEEE Transactions on Robotics and Automation 18(5),
2002, in its centralised form; errors and Jacobians as in mekf.py. A bearing from i to a point z_j = p_j + R_j m_j of
vehicle j also has H_j = B Rhat_i^T Rhat_j [-S(m_j), I] / |d|.
"""

from collections.abc import Sequence

import numpy as np

from coopenv.estimation.arrays import Array
from coopenv.estimation.rotations import orthonormalise, skew
from coopenv.observers.contract import Estimate, Message, Setup, Tick
from coopenv.observers.mekf import LeftError, innovation, kalman


class Centralised:
    """One filter over all vehicles and all measurements.

    It reads no messages, so their loss and delay change nothing.
    """

    joint = True

    def __init__(self, setups: Sequence[Setup]) -> None:
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
        rows = [self.rows(i, tick) for i, tick in enumerate(ticks) if tick.due and tick.valid.any()]
        if rows:
            H, residual, variances = (np.concatenate(parts) for parts in zip(*rows, strict=True))
            dx, self.P, _ = kalman(self.P, H, np.diag(variances), residual)
            self.move(dx)
        odometry = [np.concatenate([tick.angular_velocity, tick.velocity]) for tick in ticks]
        seen = [tick.bearings[tick.valid] for tick in ticks]
        self.sent = [Message(extra={"odometry": o, "bearings": b}) for o, b in zip(odometry, seen, strict=True)]
        return [
            LeftError(R, p, self.P[self.block(i), self.block(i)].copy()).estimate()
            for i, (R, p) in enumerate(self.poses)
        ]

    def predict(self, ticks: Sequence[Tick]) -> None:
        """Carry every pose and the joint covariance through one tick of odometry."""
        F = np.zeros_like(self.P)
        for i, (tick, (R, p)) in enumerate(zip(ticks, self.poses, strict=True)):
            F[self.block(i), self.block(i)] = LeftError.transition(tick.rotation, tick.translation)
            self.poses[i] = orthonormalise(R.dot(tick.rotation)), p + R.dot(tick.translation)
        noise = np.concatenate([tick.noise.odometry(tick.dt) for tick in ticks])
        self.P = F.dot(self.P).dot(F.T) + np.diag(noise)

    def rows(self, i: int, tick: Tick) -> tuple[Array, Array, Array]:
        """Return (H (2m, 6N), residual (2m,), variances (2m,)) of the bearings of vehicle i."""
        R, p = self.poses[i]
        targets = tick.targets[tick.valid].tolist()
        z = np.array([self.place(target, tick) for target in targets])
        residual, J = innovation(R, p, tick.lever_arm, tick.bearings[tick.valid], z)
        H = np.zeros((len(z), 2, len(self.P)))
        H[:, :, self.block(i)] = J @ LeftError(R, p, self.P).jacobian(z)
        for n, target in enumerate(targets):
            if (j := target - self.landmarks) >= 0:
                G = J[n].dot(R.T).dot(self.poses[j][0])
                H[n, :, self.block(j)] = np.concatenate([G.dot(skew(-self.markers[j])), G], axis=1)
        return H.reshape(-1, len(self.P)), residual.ravel(), np.full(2 * len(z), tick.noise.bearing_std**2)

    def place(self, target: int, tick: Tick) -> Array:
        """Return (3,) where a target is, or is believed to be, map frame, m."""
        if target < self.landmarks:
            landmark: Array = tick.landmarks[target]
            return landmark
        R, p = self.poses[target - self.landmarks]
        marker: Array = p + R.dot(self.markers[target - self.landmarks])
        return marker

    def move(self, dx: Array) -> None:
        """Move every pose by its part of the error."""
        for i, (R, p) in enumerate(self.poses):
            moved = LeftError(R, p, self.P).moved(dx[self.block(i)], self.P)
            self.poses[i] = moved.R, moved.p

    def messages(self) -> list[Message]:
        """Return the raw measurements of this tick: odometry and bearings."""
        return self.sent
