"""Where landmarks and its own odometry alone put a vehicle, whatever others say."""

from __future__ import annotations

import numpy as np

from coopenv.estimation.arrays import Array
from coopenv.observers.contract import SensorNoise, Tick
from coopenv.observers.robust.constants import (
    ALONE_NOISE,
    ALONE_TIME,
    BEARING_GATE,
    BEND_TIME,
    CONSIDERED_BEND_TIME,
    CONSISTENT_QUANTILE,
    ERRORS_TIME,
    NOT_AHEAD,
    SAME_TIME,
)
from tests.oracles.robust.belief import Belief
from tests.oracles.robust.odometry import as_noise
from tests.oracles.robust.sight import Sight, View


class Alone:
    """An estimate of the vehicle's pose that is carried on by its odometry and corrected by landmarks now and then."""

    def __init__(self, R: Array, p: Array, P: Array, odometry: tuple[Array, Array], time: float) -> None:
        """Start at a pose, at a time by dead reckoning (s)."""
        self.belief = Belief(0, R, p, P.copy(), time)
        self.odometry = odometry
        self.lost = False  # whether landmarks are in view and none fits

    def is_due(self, time: float) -> bool:
        """Return whether it is to be corrected."""
        return time - self.belief.own.time > ALONE_TIME - SAME_TIME

    def follow(self, odometry: tuple[Array, Array], time: float, noise: SensorNoise, errors: Array | None) -> float:
        """Carry it on to where the odometry has led, whose lasting errors have a covariance (6, 6); return the time."""
        (R, p), self.odometry, dt = self.odometry, odometry, time - self.belief.own.time
        dR, dp = R.T.dot(odometry[0]), R.T.dot(odometry[1] - p)
        self.belief.move(0, dR, dp, ALONE_NOISE * (noise.odometry(dt) + as_noise(errors, dp, dt, ERRORS_TIME)))
        self.belief.own.time = time
        return dt

    def correct(self, tick: Tick, landmarks: int, variance: float, mounting: Array, dt: float) -> int:
        """Correct it by the bearings to landmarks that fit, dt after the last ones; return how many there are.

        What does not change from frame to frame, as the mounting's error does not, counts as one measurement.
        """
        seen = np.flatnonzero(tick.valid & (tick.targets < landmarks))
        turn, shift = ALONE_NOISE * mounting * max(CONSIDERED_BEND_TIME / dt, 1.0)
        variance = ALONE_NOISE * variance + turn
        period = dt * BEND_TIME / CONSIDERED_BEND_TIME

        def look() -> tuple[Sight, Array]:
            z = tick.landmarks[tick.targets[seen]]
            sight = self.belief.sight(tick.bearings[seen], tick.lever_arm, z, period=period)
            return sight, variance + shift / sight.distance**2 + sight.bend

        sight, noise = look()
        fits = sight.ahead & (sight.normalised(self.belief.P, noise) < BEARING_GATE)
        if fits.any():
            self.belief.settle(sight, noise, fits, look)
        self.lost = len(seen) > 0 and not fits.any()
        return int(fits.sum())

    def replace_own(self, belief: Belief) -> None:
        """Let a belief in oneself be this, which depends on nobody."""
        belief.own.R, belief.own.p = self.belief.own.R, self.belief.own.p
        belief.P[:6, 6:], belief.P[6:, :6] = 0.0, 0.0
        belief.P[:6, :6] = self.belief.P


def cost_of(view: View, P: Array, bearings: list[int]) -> float:
    """Return the normalised innovation squared of some bearings of a frame together, under a covariance P."""
    if not bearings:
        return 0.0
    H = view.sight.H[bearings].reshape(-1, len(P))
    r = np.where(view.sight.ahead[bearings, None], view.sight.residual[bearings], NOT_AHEAD).ravel()
    S = H.dot(P).dot(H.T) + np.diag(np.repeat(view.noise[bearings], 2))
    return float(r.dot(np.linalg.solve(S, r)))


def most_of_consistent(bearings: int) -> float:
    """Return what so many bearings that agree cost at most."""
    if not bearings:
        return 0.0
    a = 2.0 / 9.0 / (2 * bearings)
    return float(2 * bearings * (1.0 - a + CONSISTENT_QUANTILE * np.sqrt(a)) ** 3)
