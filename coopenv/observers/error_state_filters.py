"""Error-state Kalman filters on SE(3): multiplicative, invariant, iterated and unscented."""

import math
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from coopenv.estimation.compiled import MATRICES, MATRIX, VECTOR, compiled, exp_so3, exp_translation, transformed
from coopenv.estimation.poses import Array, cholesky, lengths, solve
from coopenv.observers.bearing_measurements import (
    FRAME,
    INVARIANT,
    LEFT,
    RIGHT,
    BearingMeasurements,
    Frame,
    LinearisedBearings,
    UncertainPose,
    across,
    dense,
    frame_of,
    linearised,
    recentring,
    usable_bearings,
)
from coopenv.observers.contract import Estimate, Message, Setup, Tick
from coopenv.observers.correction import InnovationGate, Stacked, iterated, turn_of_sight, updated
from coopenv.observers.kernel_observer import KernelObserver
from coopenv.observers.riccati.kernels import RICCATI


class PoseObserver:
    """Base of observers that estimate one pose with a covariance and broadcast the position of their marker."""

    kind: ClassVar[int] = LEFT  # of the error
    sends_covariance = True

    def __init__(self, setup: Setup) -> None:
        self.marker = setup.marker  # the point that cameras of other vehicles measure

    def reset(self, initial_pose: tuple[Array, Array], initial_covariance: Array) -> None:
        """Start at a pose."""
        self.state = UncertainPose.start(self.kind, *initial_pose, initial_covariance)

    def message(self) -> Message:
        """Return the marker's position, and its covariance if this observer sends it."""
        covariance = self.state.point_covariance(self.marker) if self.sends_covariance else None
        return Message(position=self.state.p + self.state.R.dot(self.marker), covariance=covariance)


class Mekf(PoseObserver):
    """Error-state filter; takes received positions as exact.

    It sends its position alone.
    """

    sends_covariance = False
    gated = True  # else every bearing is used

    def reset(self, initial_pose: tuple[Array, Array], initial_covariance: Array) -> None:
        """Start at a pose."""
        super().reset(initial_pose, initial_covariance)
        self.gate = InnovationGate()

    def update(self, tick: Tick) -> Estimate:
        """Predict, then correct by every usable bearing."""
        self.predict(tick)
        self.nis: float | None = None
        self.nis_dof = 0
        measured = usable_bearings(tick, self.sends_covariance) if tick.due else None
        if measured is not None:
            self.take(tick, measured)
        return self.state.estimate(self.nis, self.nis_dof)

    def predict(self, tick: Tick) -> None:
        """Append the increment."""
        self.state = self.state.predicted(tick)

    def take(self, tick: Tick, measured: BearingMeasurements) -> None:
        """Correct by the bearings that pass the gate."""
        if self.gated:
            linear = linearised(self.state, tick, measured)
            S = self.spread(measured, linear)
            kept = self.gate.passed(tick.time, linear.residual, S, linear.ahead)
            if not kept.all():
                measured = measured.only(kept)
        if len(measured.targets):
            self.correct(tick, measured)

    def spread(self, measured: BearingMeasurements, linear: LinearisedBearings) -> Array:
        """Return (m, 2, 2) the covariances of the innovations."""
        return linear.spread(self.state.P)

    def correct(self, tick: Tick, measured: BearingMeasurements) -> None:
        """Correct by bearings."""
        self.nis, self.nis_dof = self.fuse(tick, measured), 2 * len(measured.targets)

    def correct_in_turn(self, tick: Tick, measured: BearingMeasurements, known: NDArray[np.bool_]) -> None:
        """Correct by the bearings of a mask (m,) at once, then by the others, to neighbours, one at a time."""
        if known.any():
            self.nis, self.nis_dof = self.fuse(tick, measured.only(known)), 2 * int(known.sum())
        for n in np.flatnonzero(~known).tolist():
            self.fuse_neighbour(tick, measured.only(slice(n, n + 1)))

    def fuse_neighbour(self, tick: Tick, one: BearingMeasurements) -> None:
        """Correct by one bearing to a neighbour."""
        self.fuse(tick, one)

    def fuse(self, tick: Tick, measured: BearingMeasurements) -> float:
        """Correct by bearings; return their normalised innovation squared."""
        *pose, nis = updated(*self.state, frame_of(tick, measured))
        self.state = UncertainPose(self.kind, *pose)
        return float(nis)


class MekfCovariance(Mekf):
    """Error-state filter; weighs received positions by covariance.

    It sends position and covariance, and adds a sender's covariance to the bearing's noise.
    """

    sends_covariance = True


class MekfCovarianceUngated(MekfCovariance):
    """Error-state filter that accepts every bearing.

    It is `mekf_covariance` without a gate and without cheirality.
    """

    gated = False


class LeftInvariant(MekfCovariance):
    """Invariant filter, left error; sends covariances."""

    kind = INVARIANT


class RightInvariant(MekfCovariance):
    """Invariant filter, right error; sends covariances."""

    kind = RIGHT


class IteratedEkf(MekfCovariance):
    """Error-state filter that iterates corrections; sends covariances."""

    def fuse(self, tick: Tick, measured: BearingMeasurements) -> float:
        """Correct by bearings, linearised anew until convergence; return their normalised innovation squared."""
        before, distance = self.state, float(lengths(measured.positions - self.state.p).min())

        def look(at: Array) -> Stacked:
            residual, H, N = linearised(before.moved(at, before.P), tick, measured).stacked()
            return residual, H.dot(recentring(before.kind, at)), N

        dx, P, nis = iterated(before.P, look, lambda dx: turn_of_sight(dx, distance))
        self.state = before.corrected(dx, P)
        return nis


class HamelSamson(KernelObserver):
    """The paper's observer with landmarks alone."""

    def __init__(self, setup: Setup) -> None:
        super().__init__(RICCATI, replace(setup, targets=setup.targets[setup.targets < setup.landmarks]))

    def message(self) -> Message:
        """Return an empty message."""
        return Message()

    def __reduce__(self) -> Any:
        return HamelSamson, (self.setup,), super().__reduce__()[2]


SPREAD = 6.0  # squared distance of the sigma points from the mean in standard deviations: alpha = 1 in six dimensions
WEIGHT = 1.0 / (2.0 * SPREAD)  # weight of every sigma point but the mean
MEAN_WEIGHT = 2.0  # weight of the mean in covariances: 3 - alpha^2. In means it is 0


class Ukf(MekfCovariance):
    """Unscented (sigma-point) filter; sends covariances."""

    kind = INVARIANT

    def take(self, tick: Tick, measured: BearingMeasurements) -> None:
        """Correct by the bearings that pass the gate."""
        P, frame = self.state.P, frame_of(tick, measured)
        xi = sigma_points(P)
        linear = linearised(self.state, tick, measured)
        mean, S, y = unscented(self.state.R, self.state.p, xi, linear.N, frame)
        r = linear.residual.ravel() - mean
        if self.gated:
            each = np.arange(len(measured.targets))
            blocks = S.reshape(len(each), 2, len(each), 2)[each, :, each, :]
            kept = self.gate.passed(tick.time, r.reshape(-1, 2), blocks, linear.ahead).repeat(2)
            if not kept.any():
                return
            if not kept.all():
                S, y, r = S[np.ix_(kept, kept)], y[:, kept], r[kept]
        solved = solve(S, np.concatenate([WEIGHT * y.T.dot(xi), r[:, None]], axis=1))
        gain = solved[:, :-1].T
        P = P - gain.dot(S).dot(gain.T)
        self.state = self.state.moved(gain.dot(r), (P + P.T) / 2)
        self.nis, self.nis_dof = float(r.dot(solved[:, -1])), len(r)


def sigma_points(P: Array) -> Array:
    """Return (12, 6) the sigma points but the mean: plus and minus the columns of a square root of SPREAD P."""
    try:
        root = cholesky(SPREAD * P).T
    except np.linalg.LinAlgError:  # singular to rounding
        values, vectors = np.linalg.eigh(SPREAD * P)
        root = (vectors * np.sqrt(np.maximum(values, 0.0))).T
    return np.concatenate([root, -root])


@compiled(VECTOR)
def unit(v: Array) -> Array:
    """Return v (3,) at length 1."""
    return v / max(math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]), 1e-9)


@compiled(MATRIX, VECTOR, MATRIX, MATRICES, FRAME)
def unscented(R: Array, p: Array, xi: Array, N: Array, frame: Frame) -> tuple[Array, Array, Array]:
    """Return the mean (2m,) and covariance (2m, 2m) of bearings in the tangent planes at the mean's, noise N included.

    The third is the deviation of each sigma point xi (k, 6), (k, 2m).
    """
    lever_arm, _, positions, _, _ = frame
    m, k = len(positions), len(xi)
    y, mean = np.empty((k, 2 * m)), np.zeros(2 * m)
    for n in range(m):
        a = transformed(R.T, positions[n] - p)
        d = unit(a - lever_arm)
        B = across(d[0], d[1], d[2])
        for s in range(k):
            theta, rho = xi[s, :3], xi[s, 3:]
            d = unit(transformed(exp_so3(theta).T, a - exp_translation(theta, rho)) - lever_arm)
            for r in range(2):
                y[s, 2 * n + r] = B[r, 0] * d[0] + B[r, 1] * d[1] + B[r, 2] * d[2]
                mean[2 * n + r] += WEIGHT * y[s, 2 * n + r]
    S = dense(N)
    for i in range(2 * m):
        for s in range(k):
            y[s, i] -= mean[i]
    for i in range(2 * m):
        for j in range(2 * m):
            S[i, j] += MEAN_WEIGHT * mean[i] * mean[j]
            for s in range(k):
                S[i, j] += WEIGHT * y[s, i] * y[s, j]
    return mean, S, y
