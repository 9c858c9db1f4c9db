"""What one vehicle believes about itself and the vehicles that it hears: poses with one covariance over all of them.

Errors are left errors, R = Rhat Exp(theta), p = phat + Rhat rho, six per member, the vehicle itself first. A member
stands at the time of its last message; until now it is carried on by its last known twist.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from coopenv.estimation.observers.base import Array, SensorNoise
from coopenv.estimation.observers.mekf import transition
from coopenv.estimation.observers.rotations import exp_so3, log_so3, orthonormalise, skew, tangent_basis

IDENTITY = np.eye(3)
TWIST_TIME = 0.3
"""s, over which a neighbour's twist is averaged."""


@dataclass
class Member:
    """One vehicle in a belief."""

    vehicle: int
    R: Array  # (3, 3) body to map
    p: Array  # (3,) map frame, m
    time: float = 0.0
    """s, at which it stands."""
    odometry: tuple[Array, Array] | None = None
    """Its pose by dead reckoning at that time; not needed of the vehicle itself."""
    v: Array | None = None
    """(3,) last known velocity in its body, m/s; None before a second message."""
    w: Array | None = None
    """(3,) last known angular velocity in its body, rad/s."""

    def carried(self, age: float) -> tuple[Array, Array]:
        """Return (dR, dp) of the motion at the last known twist for a time."""
        if age <= 0.0 or self.v is None or self.w is None:
            return IDENTITY, np.zeros(3)
        return exp_so3(self.w * age), exp_so3(self.w * (age / 2)) @ self.v * age


class Line(NamedTuple):
    """A bearing as a measurement: residual = H x + noise, and whether the target is ahead at all."""

    H: Array  # (2, 6n)
    residual: Array  # (2,) rad
    ahead: bool


class Belief:
    """Members and their joint covariance (6n, 6n)."""

    def __init__(self, vehicle: int, R: Array, p: Array, P: Array, time: float = 0.0) -> None:
        """Start with the vehicle itself."""
        self.members = [Member(vehicle, R, p, time)]
        self.P = P

    @property
    def own(self) -> Member:
        """The vehicle itself."""
        return self.members[0]

    def place(self, vehicle: int) -> int | None:
        """Return a vehicle's number among the members, None if it is not one."""
        return next((n for n, member in enumerate(self.members) if member.vehicle == vehicle), None)

    def add(self, members: list[Member], P: Array) -> None:
        """Take in members whose errors are independent of those of the others."""
        n, m = len(self.P), len(P)
        joint = np.zeros((n + m, n + m))
        joint[:n, :n], joint[n:, n:] = self.P, P
        self.P = joint
        self.members.extend(members)

    def drop(self, vehicles: set[int]) -> None:
        """Forget members."""
        keep = [n for n, member in enumerate(self.members) if member.vehicle not in vehicles]
        index = np.concatenate([np.arange(6 * n, 6 * n + 6) for n in keep])
        self.P = self.P[np.ix_(index, index)]
        self.members = [self.members[n] for n in keep]

    def move(self, n: int, dR: Array, dp: Array, noise: Array) -> None:
        """Carry a member through an odometry increment with noise variances (6,)."""
        member = self.members[n]
        member.p = member.p + member.R @ dp
        member.R = orthonormalise(member.R @ dR)
        F, block = transition(dR, dp), slice(6 * n, 6 * n + 6)
        self.P[block] = F @ self.P[block]
        self.P[:, block] = self.P[:, block] @ F.T
        index = np.arange(6 * n, 6 * n + 6)
        self.P[index, index] += noise

    def follow(self, n: int, odometry_R: Array, odometry_p: Array, time: float, noise: SensorNoise) -> None:
        """Carry a member on to where its own odometry says that it was at a time."""
        member = self.members[n]
        dt = time - member.time
        if dt <= 0.0 or member.odometry is None:
            return
        R, p = member.odometry
        dR, dp = R.T @ odometry_R, R.T @ (odometry_p - p)
        self.move(n, dR, dp, noise.odometry(dt))
        v, w = dp / dt, log_so3(dR) / dt
        if member.v is None or member.w is None:
            member.v, member.w = v, w
        else:
            share = min(1.0, dt / TWIST_TIME)
            member.v, member.w = member.v + share * (v - member.v), member.w + share * (w - member.w)
        member.time, member.odometry = time, (odometry_R, odometry_p)

    def line(self, bearing: Array, lever_arm: Array, z: Array, n: int | None, point: Array | None) -> Line:
        """Return a bearing as a measurement.

        Args:
            bearing: (3,) unit vector, body frame.
            lever_arm: (3,) the camera's place in the body, m.
            z: (3,) where the target is believed to be, map frame, m.
            n: the member that the target belongs to; None: a landmark.
            point: (3,) of the target in that member's body, m.
        """
        own = self.own
        a = own.R.T @ (z - own.p)
        d = a - lever_arm
        distance = max(float(np.sqrt(d @ d)), 1e-9)
        u = d / distance
        B = tangent_basis(u[None])[0] / distance
        H = np.zeros((2, len(self.P)))
        H[:, :3], H[:, 3:6] = B @ skew(a), -B
        if n is not None and point is not None:
            G = B @ own.R.T @ self.members[n].R
            H[:, 6 * n : 6 * n + 3], H[:, 6 * n + 3 : 6 * n + 6] = -G @ skew(point), G
        return Line(H, distance * (B @ bearing), float(u @ bearing) > 0.0)

    def correct(self, H: Array, N: Array, residual: Array) -> None:
        """Take independent measurements residual = H x + noise of covariance N, in Joseph's form."""
        PHt = self.P @ H.T
        K = np.linalg.solve(H @ PHt + N, PHt.T).T
        A = -K @ H
        A.flat[:: len(A) + 1] += 1.0
        P = A @ self.P @ A.T + K @ N @ K.T
        self.P = (P + P.T) / 2
        self.shift(K @ residual)

    def inform(self, index: Array, information: Array, vector: Array) -> None:
        """Take information about some errors x: their likelihood has the exponent vector^T x - x^T information x / 2.

        Args:
            index: (m,) which errors.
            information: (m, m).
            vector: (m,).
        """
        columns = self.P[:, index]
        W = np.linalg.inv(np.eye(len(index)) + self.P[np.ix_(index, index)] @ information)
        gain = columns @ W.T
        M = information @ W
        P = self.P - columns @ ((M + M.T) / 2) @ columns.T
        self.P = (P + P.T) / 2
        self.shift(gain @ vector)

    def shift(self, dx: Array) -> None:
        """Move the poses of the first members by their part of the error dx (6m,)."""
        for n in range(len(dx) // 6):
            member = self.members[n]
            member.p = member.p + member.R @ dx[6 * n + 3 : 6 * n + 6]
            member.R = member.R @ exp_so3(dx[6 * n : 6 * n + 3])
