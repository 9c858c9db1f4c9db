"""What a vehicle makes of what another one says: its place against its odometry, and against bearings."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from coopenv.estimation.arrays import Array
from coopenv.estimation.rotations import orthonormalise
from coopenv.observers.contract import SensorNoise
from coopenv.observers.mekf import LeftError
from coopenv.observers.robust.constants import (
    ADMISSION,
    AGREEMENT_TIME,
    DRIFT_STD,
    DRIFT_TIME,
    ERRORS_TIME,
    EVIDENCE_SHARE,
    JUMP_STD,
    LEAST_CERTAINTY,
    MAX_OFFENCES,
    MAX_SMOOTH_ACCELERATION,
    NEWS_TIME,
    SAME_TIME,
    SILENCE_TIME,
    SLACK,
    SLOW_DRIFT_TIME,
)
from tests.oracles.robust.belief import Member
from tests.oracles.robust.odometry import as_noise
from tests.oracles.robust.tracklets import Report


@dataclass
class Drift:
    """A sum of steps, which forgets."""

    time: float  # s, in which it forgets
    sum: Array = field(default_factory=lambda: np.zeros(3))
    covariance: Array = field(default_factory=lambda: np.zeros((3, 3)))

    def add(self, x: Array, N: Array, dt: float) -> None:
        """Add a step of covariance N, dt after the last one."""
        share = np.exp(-dt / self.time)
        self.sum, self.covariance = share * self.sum + x, share**2 * self.covariance + N


@dataclass
class Word:
    """What is thought of one sender; along the axes of the map."""

    offset: Array = field(default_factory=lambda: np.zeros(3))  # 1/m
    certainty: Array = field(default_factory=lambda: LEAST_CERTAINTY * np.eye(3))  # 1/m^2
    drift: Drift = field(default_factory=lambda: Drift(DRIFT_TIME))
    slow_drift: Drift = field(default_factory=lambda: Drift(SLOW_DRIFT_TIME))
    missed: float = 0.0
    fitted: float = 0.0  # s
    perjured: bool = False  # whether the sender is not believed because it has contradicted itself
    offences: int = 0
    barred_until: float = 0.0  # s

    def is_barred(self, time: float) -> bool:
        """Return whether the sender is not to be believed yet."""
        return time < self.barred_until - SAME_TIME

    def offend(self, time: float) -> Word:
        """Return what is thought of a sender that is not believed any more."""
        offences = min(self.offences + 1, MAX_OFFENCES)
        until = time + AGREEMENT_TIME * 2 ** (offences - 1)
        return Word(slow_drift=self.slow_drift, offences=offences, barred_until=until)

    def step(self, last: Report, new: Report, noise: SensorNoise, errors: Array | None, trusted: bool = True) -> None:
        """Take note of the step from where the odometry has led since the last report to the new one.

        Of who is not believed there is no evidence.
        """
        dR, dp = new.motion_since(last, 0)
        dt = float(new.time[0] - last.time[0])
        lasting = as_noise(errors, dp, dt, ERRORS_TIME)
        Q = noise.odometry(dt) + lasting
        F = LeftError.transition(dR, dp)
        before = (F.dot(last.P).dot(F.T) + np.diag(Q))[3:, 3:]
        R, N = orthonormalise(last.R[0].dot(dR)), before - new.P[3:6, 3:6]
        x = new.p[0] - (last.p[0] + last.R[0].dot(dp))
        if dt > SILENCE_TIME or N.trace() < -ADMISSION * before.trace():
            self.drift, self.slow_drift = Drift(DRIFT_TIME), Drift(SLOW_DRIFT_TIME)
        N = (R.dot(N).dot(R.T) if N.trace() >= 0.0 else np.zeros((3, 3))) + SLACK * Q[3] * np.eye(3)
        for drift in (self.drift, self.slow_drift):  # in which errors that last are the same
            drift.add(x, N + drift.time / ERRORS_TIME * lasting[3] * np.eye(3), dt)
        if not trusted:
            return
        covariance = np.linalg.inv(self.certainty)
        believed = covariance.dot(self.offset) - x
        self.certainty = np.linalg.inv(covariance + Q[3] * np.eye(3))
        self.offset = self.certainty.dot(believed)

    def drifted(self, gate: float, least: float) -> float:
        """Return how far the sender has drifted, in m, if by more than it may and by `least`, else 0."""
        for drift in (self.drift, self.slow_drift):
            far = float(np.linalg.norm(drift.sum))
            if float(drift.sum.dot(np.linalg.solve(drift.covariance, drift.sum))) > gate and far > least:
                return far
        return 0.0

    def weigh(self, R: Array, P: Array, correction: Array, spread: Array, share: float) -> None:
        """Add a correction (3,) that is not carried out, and its covariance, of a position of covariance P (3, 3)."""
        inverse = R.dot(np.linalg.inv(P))
        self.offset = self.offset + share * inverse.dot(correction)
        self.certainty = self.certainty + share * inverse.dot(spread).dot(inverse.T)

    def contradiction(self, R: Array, P: Array) -> tuple[float, float]:
        """Return by how much bearings contradict the sender, squared, and a likely error, m."""
        covariance = np.linalg.inv(self.certainty)
        b = covariance.dot(self.offset)
        size = float(b.dot(np.linalg.solve(R.dot(P).dot(R.T) + covariance, b)))
        return size, float(np.linalg.norm(np.linalg.solve(self.certainty + np.eye(3), self.offset)))


def least_drift(report: Report) -> float:
    """Return by how much a sender must drift not to be believed, m."""
    return DRIFT_STD * float(np.sqrt(report.P[3:6, 3:6].trace() / 3.0))


def has_jumped(member: Member, dp: Array, dt: float, noise: SensorNoise) -> bool:
    """Return whether a member's odometry changes by more than brakes can."""
    if member.v is None:
        return False
    std = np.sqrt(member.velocity_variance * dt * dt + noise.odometry(dt)[3])
    return float(np.linalg.norm(dp - member.v * dt)) > MAX_SMOOTH_ACCELERATION / 2.0 * dt * dt + JUMP_STD * std


def share_of(variance: float, noise: Array, dt: float) -> float:
    """Return which share of a frame's information counts, by the noise (m,) of its bearings."""
    frames = max(NEWS_TIME / dt, 1.0)
    most = max([variance, *(variance + frames * (noise - variance)).tolist()])
    return EVIDENCE_SHARE * variance / most
