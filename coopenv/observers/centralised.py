"""Extended Kalman filter over the stacked left errors of all vehicles: the upper reference.

Source: Roumeliotis and Bekey, Distributed multirobot localization, IEEE Transactions on Robotics and Automation 18(5),
2002, in its centralised form; errors and Jacobians as in error_state_filters.py. A bearing from i to a point z_j = p_j
+ R_j m_j of vehicle j also has H_j = B Rhat_i^T Rhat_j [-S(m_j), I] / |d|. Each vehicle has a gate; corrections are
linearised half way (correction.py).
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from coopenv.estimation.poses import Array, exp_so3, orthonormalise, skew
from coopenv.observers import bearing_measurements
from coopenv.observers.bearing_measurements import (
    LEFT,
    BearingMeasurements,
    LinearisedBearings,
    UncertainPose,
    increment,
    linearised,
    transition,
)
from coopenv.observers.contract import Estimate, Message, Setup, Tick
from coopenv.observers.correction import InnovationGate, Stacked, gain, joseph

Masks = dict[int, NDArray[np.bool_]]
"""Of the targets of vehicles that saw any."""


class Centralised:
    """One filter over all vehicles and all measurements.

    It reads no messages, so their loss and delay change nothing.
    """

    joint = True
    halfway = True  # whether corrections are linearised half way, else at the prediction

    def __init__(self, setups: Sequence[Setup]) -> None:
        """Take the setups of all."""
        self.landmarks = setups[0].landmarks
        self.markers = [setup.marker for setup in setups]

    def reset(self, initial_poses: Sequence[tuple[Array, Array]], initial_covariances: Sequence[Array]) -> None:
        """Start with independent errors."""
        self.poses = [(np.array(R, float), np.array(p, float)) for R, p in initial_poses]
        self.P = np.zeros((6 * len(self.poses), 6 * len(self.poses)))
        for i, covariance in enumerate(initial_covariances):
            self.P[self.block(i), self.block(i)] = covariance
        self.sent = [Message() for _ in self.poses]
        self.gates = [InnovationGate() for _ in self.poses]

    @staticmethod
    def block(i: int) -> slice:
        """Return the place of vehicle i in the state."""
        return slice(6 * i, 6 * i + 6)

    def update(self, ticks: Sequence[Tick]) -> list[Estimate]:
        """Predict every vehicle, then correct by all bearings in one update."""
        self.predict(ticks)
        seen = {i: tick.valid for i, tick in enumerate(ticks) if tick.due and tick.valid.any()}
        if seen:
            self.correct(ticks, seen)
        odometry = [np.concatenate([tick.angular_velocity, tick.velocity]) for tick in ticks]
        bearings = [tick.bearings[tick.valid] for tick in ticks]
        self.sent = [Message(extra={"odometry": o, "bearings": b}) for o, b in zip(odometry, bearings, strict=True)]
        return [UncertainPose(LEFT, R, p, self.covariance(i)).estimate() for i, (R, p) in enumerate(self.poses)]

    def covariance(self, i: int) -> Array:
        """Return the covariance (6, 6) of the left error of vehicle i."""
        return self.P[self.block(i), self.block(i)].copy()

    def predict(self, ticks: Sequence[Tick]) -> None:
        """Carry every pose and the joint covariance through one tick of odometry."""
        F = np.zeros_like(self.P)
        for i, (tick, (R, p)) in enumerate(zip(ticks, self.poses, strict=True)):
            F[self.block(i), self.block(i)] = transition(*increment(tick))
            self.poses[i] = orthonormalise(R.dot(tick.rotation)), p + R.dot(tick.translation)
        noise = np.concatenate([tick.noise.odometry(tick.dt) for tick in ticks])
        self.P = F.dot(self.P).dot(F.T) + np.diag(noise)

    def correct(self, ticks: Sequence[Tick], seen: Masks) -> None:
        """Correct by the bearings of masks (m,) by vehicle that pass the vehicles' gates, in one update."""
        before, P = self.poses, self.P
        linear = {i: self.linearise(i, ticks[i], mask) for i, mask in seen.items()}
        kept = {
            i: self.gates[i].passed(ticks[i].time, of.residual, of.spread(P), in_front)
            for i, (of, in_front) in linear.items()
        }
        residual, H, N = _stacked([of.only(kept[i]) for i, (of, _) in linear.items()])
        if not len(residual):
            return
        for i, mask in seen.items():
            seen[i] = mask.copy()
            seen[i][mask] = kept[i]
        K, dx, _ = gain(P, H, N, residual)
        if self.halfway:
            at = 0.5 * dx
            self.poses = self.moved(before, at)
            residual, H, N = _stacked([self.linearise(i, ticks[i], mask)[0] for i, mask in seen.items()])
            H = H.dot(self.recentring(at))
            K, dx, _ = gain(P, H, N, residual + H.dot(at))
        G = self.recentring(dx)
        self.poses, self.P = self.moved(before, dx), G.dot(joseph(P, K, H, N)).dot(G.T)

    def linearise(self, i: int, tick: Tick, mask: NDArray[np.bool_]) -> tuple[LinearisedBearings, NDArray[np.bool_]]:
        """Return the bearings of a mask (m,) of vehicle i, linearised by all errors, and whether they point ahead."""
        R, p = self.poses[i]
        targets = tick.targets[mask].tolist()
        z = np.array([self.place(target, tick) for target in targets], float).reshape(-1, 3)
        bearings = np.asarray(tick.bearings[mask], float)
        known = BearingMeasurements(bearings, z, np.zeros((len(z), 3, 3)), np.array(targets), (None,) * len(z))
        own = linearised(UncertainPose(LEFT, R, p, self.P), tick, known)
        H = np.zeros((len(z), 2, len(self.P)))
        H[:, :, self.block(i)] = own.H
        for n, target in enumerate(targets):
            if (j := target - self.landmarks) >= 0:
                G = own.G[n].dot(self.poses[j][0])
                H[n, :, self.block(j)] = np.concatenate([G.dot(skew(-self.markers[j])), G], axis=1)
        return own._replace(H=H), (((z - p).dot(R) - tick.lever_arm) * bearings).sum(1) > 0.0

    def place(self, target: int, tick: Tick) -> Array:
        """Return (3,) the known or estimated position of a target, map frame, m."""
        if target < self.landmarks:
            landmark: Array = tick.landmarks[target]
            return landmark
        R, p = self.poses[target - self.landmarks]
        marker: Array = p + R.dot(self.markers[target - self.landmarks])
        return marker

    @staticmethod
    def moved(poses: Sequence[tuple[Array, Array]], dx: Array) -> list[tuple[Array, Array]]:
        """Return poses moved by their errors (6N,)."""
        return [(R.dot(exp_so3(e[:3])), p + R.dot(e[3:])) for (R, p), e in zip(poses, dx.reshape(-1, 6), strict=True)]

    @staticmethod
    def recentring(dx: Array) -> Array:
        """Return (6N, 6N) what `bearing_measurements.recentring` returns, of every pose."""
        G = np.zeros((len(dx), len(dx)))
        for n in range(0, len(dx), 6):
            G[n : n + 6, n : n + 6] = bearing_measurements.recentring(LEFT, dx[n : n + 6])
        return G

    def messages(self) -> list[Message]:
        """Return the raw measurements of this tick: odometry and bearings."""
        return self.sent


def _stacked(linear: Sequence[LinearisedBearings]) -> Stacked:
    return LinearisedBearings(*(np.concatenate(parts) for parts in zip(*linear, strict=True))).stacked()
