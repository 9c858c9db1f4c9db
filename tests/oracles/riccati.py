"""The paper's Riccati observer in NumPy, for one vehicle: the kernels' integration, through modes for any gain."""

from __future__ import annotations

from math import sqrt

import numpy as np

from coopenv.estimation.poses import IDENTITY, Array, Coordinates, cholesky, exp_so3, orthonormalise, skew
from coopenv.observers.contract import Estimate, Message, Setup, Tick

MOST_SUBSTEPS = 200


class Riccati:
    """The paper's observer, with the scenario's gains.

    R and p as in the paper: p is the position in the body frame.
    """

    landmarks_only = False

    def __init__(self, setup: Setup) -> None:
        """Take the gains of this vehicle."""
        self.gains, self.marker = setup.gains, setup.marker
        self.V = np.repeat(self.gains.V, 3)

    def reset(self, initial_pose: tuple[Array, Array], initial_covariance: Array) -> None:
        """Start at a pose with the scenario's P(0); the given covariance is not used, P being none."""
        self.R, position = (np.array(x, float) for x in initial_pose)
        self.p = self.R.T @ position
        self.P = np.diag(np.repeat(self.gains.P0, 3))
        self.since = 0.0

    def update(self, tick: Tick) -> Estimate:
        """Predict by the odometry, then let the bearings act for the time since the last correction."""
        E = tick.rotation.T
        self.R, self.p = self.R.dot(tick.rotation), E.dot(self.p + tick.translation)
        F = np.zeros((6, 6))
        F[:3, :3] = F[3:, 3:] = E
        self.P = F.dot(self.P).dot(F.T)
        self.P.flat[::7] += self.V * tick.dt
        self.since += tick.dt
        if tick.due:
            self.correct(tick, self.since)
            self.since = 0.0
        self.R = orthonormalise(self.R)
        return Estimate(self.R, self.R.dot(self.p), self.P, Coordinates.RICCATI)

    def correct(self, tick: Tick, duration: float) -> None:
        """Follow the correction for a duration, with C anew whenever the attitude has turned by max_turn."""
        seen = [s for s in tick.usable() if s[3] is None or not self.landmarks_only]
        if not seen:
            return
        q = np.repeat(self.gains.q[[s[0] for s in seen]], 3)  # of every row of C
        b, z = np.array([s[1] for s in seen]), np.array([s[2] for s in seen])
        Pi = IDENTITY - b[:, :, None] * b[:, None, :]
        R, p, P = self.R, self.p, self.P
        remaining, substeps, k, limit = duration, 0, self.gains.k, self.gains.max_turn
        while remaining > duration * 1e-9:
            a = z.dot(R)
            C = np.concatenate([Pi @ skew(-a), Pi], axis=2).reshape(-1, 6)
            weighted = C.T * q
            M, r = weighted.dot(C), weighted.dot((a - tick.lever_arm - p).ravel())
            L = cholesky((P + P.T) / 2)
            m, U = np.linalg.eigh(L.T.dot(M).dot(L))
            m, T = np.maximum(m, 0.0), L.dot(U)
            along, h, substeps = T.T.dot(r), remaining, substeps + 1
            dx = T.dot(gain_factor(k, m, h) * along)
            while (turn := sqrt(dx[:3].dot(dx[:3]))) > limit and substeps < MOST_SUBSTEPS:
                h *= min(max(0.9 * limit / turn, 0.1), 0.9)
                dx = T.dot(gain_factor(k, m, h) * along)
            R, p, P = R.dot(exp_so3(dx[:3])), p + dx[3:], (T / (1.0 + m * h)).dot(T.T)
            remaining -= h
        if np.isfinite(p).all() and np.isfinite(P).all() and np.isfinite(R).all():
            self.R, self.p, self.P = R, p, (P + P.T) / 2

    def message(self) -> Message:
        """Return the position; the sender adds its marker itself."""
        return Message(position=self.R.dot(self.p + self.marker))


def gain_factor(k: float, m: Array, h: float) -> Array:
    """Return (1 - (1 + m h)^-k) / m, the exact flow of modes of information m over h; k h as m -> 0."""
    tiny = m < 1e-14
    safe = np.where(tiny, 1.0, m)
    return np.where(tiny, k * h, -np.expm1(-k * np.log1p(safe * h)) / safe)
