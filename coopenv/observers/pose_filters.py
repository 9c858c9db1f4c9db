"""Filters of one vehicle's pose on SE(3): error-state Kalman filters, the pose of a single frame, dead reckoning.

The Kalman filters are multiplicative, invariant, iterated and unscented.
"""

import math
from dataclasses import replace
from itertools import combinations, islice
from math import inf, sqrt
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from coopenv.estimation.compiled import MATRICES, MATRIX, VECTOR, compiled, exp_so3, exp_translation, transformed
from coopenv.estimation.poses import Array, cholesky, lengths, solve
from coopenv.measurements.sensor import CURVATURE_TIME
from coopenv.observers.contract import Estimate, Message, Setup, Tick
from coopenv.observers.correction import (
    NO_CONSTANTS,
    NO_CROSSES,
    NO_PLACES,
    InnovationGate,
    Judgement,
    curvature,
    iterated,
    judged,
    judged_frame,
    look_from,
    turn_of_sight,
    updated,
)
from coopenv.observers.frame import CAMERA, FRAME, Frame, UsableMeasurements, usable_measurements
from coopenv.observers.guard import Guard
from coopenv.observers.kernel_observer import KernelObserver
from coopenv.observers.lasting_errors import LastingErrors
from coopenv.observers.linearisation import LinearMeasurements, across, dense, linearised, normalised
from coopenv.observers.p3p import solve_p3p
from coopenv.observers.riccati import RICCATI
from coopenv.observers.uncertain_pose import INVARIANT, LEFT, RIGHT, UncertainPose


class PoseObserver:
    """Base of observers that estimate one pose with a covariance and broadcast the position of their marker."""

    kind: ClassVar[int] = LEFT  # of the error
    sends_covariance = True

    def __init__(self, setup: Setup) -> None:
        self.marker = setup.marker  # the point that sensors of other vehicles measure
        self.needed = {name for sensor in setup.sensors for name in sensor.kind.needs}
        if setup.noise.latency or setup.noise.latency_jitter:
            self.needed.add("velocity")
        self.twist = np.zeros(3), np.zeros(3)  # m/s and rad/s, body axes

    def reset(self, initial_pose: tuple[Array, Array], initial_covariance: Array) -> None:
        """Start at a pose."""
        self.state = UncertainPose.start(self.kind, *initial_pose, initial_covariance)

    @property
    def stated(self) -> UncertainPose:
        """The estimate as it is stated and broadcast."""
        return self.state

    def message(self) -> Message:
        """Return the marker's position, its covariance if this observer sends it, and what sensors need beside."""
        position = self.state.p + self.state.R.dot(self.marker)
        if "rotation" in self.needed:
            covariance = self.stated.marker_covariance(self.marker) if self.sends_covariance else None
            return Message(position, self.state.R, covariance, self.extra())
        covariance = self.stated.point_covariance(self.marker) if self.sends_covariance else None
        return Message(position=position, covariance=covariance, extra=self.extra())

    def extra(self) -> dict[str, Array]:
        """Return the velocity of the marker, map, m/s, if sensors or late frames need it."""
        if "velocity" not in self.needed:
            return {}
        velocity, rate = self.twist
        return {"velocity": self.state.R.dot(velocity + np.cross(rate, self.marker))}


class Mekf(PoseObserver):
    """Error-state filter; takes received positions as exact.

    It sends its position alone.
    """

    sends_covariance = False
    gated = True  # else every bearing is used
    guarded = False  # whether a guard multiplies the covariance that is stated and broadcast
    counts_errors = True  # whether declared errors of sensors and map count as noise

    def __init__(self, setup: Setup) -> None:
        super().__init__(setup)
        self.lasting = LastingErrors(setup)
        self.counts_errors = self.counts_errors and self.lasting.counts

    def reset(self, initial_pose: tuple[Array, Array], initial_covariance: Array) -> None:
        """Start at a pose."""
        super().reset(initial_pose, initial_covariance)
        self.gate, self.guard = InnovationGate(), Guard()
        self.lasting.reset()
        self.measured: dict[int, float] = {}  # s, time of the last measurement of each sensor beside the camera

    def update(self, tick: Tick) -> Estimate:
        """Predict, then correct by every usable bearing."""
        if tick.bearing_age > 0.0:
            self.needed.add("velocity")
        self.predict(tick)
        self.nis: float | None = None
        self.nis_dof = 0
        measured = usable_measurements(tick, self.sends_covariance) if tick.due else None
        if measured is not None:
            if self.counts_errors:
                self.lasting.count(tick, measured, self.state.R, self.state.p)
            self.take(tick, measured)
        return self.stated.estimate(self.nis, self.nis_dof)

    @property
    def stated(self) -> UncertainPose:
        """The estimate as it is stated and broadcast: the covariance has the factor of the guard."""
        factor = self.guard.factor
        return self.state if factor == 1.0 else self.state._replace(P=factor * self.state.P)

    def predict(self, tick: Tick) -> None:
        """Append the increment."""
        self.twist = tick.velocity, tick.angular_velocity
        self.state = self.state.predicted(tick)

    def take(self, tick: Tick, measured: UsableMeasurements) -> None:
        """Correct by the bearings that pass the gate."""
        if len(measured.sensors) > 1:
            self.add_curvature(tick, measured)
        if self.gated:
            judgement = self.judged(measured)
            kept = self.gate.passed(tick.time, judgement)
            if self.guarded:
                last = (measured.targets >= len(tick.landmarks)) | (measured.entries["covariance"][:, 3, 3] > 0.0)
                last |= self.lasting.estimated < len(self.lasting.states)
                self.guard.add(tick.time, measured.targets, judgement[-1], last)
            if not kept.all():
                measured = measured.only(kept)
        if len(measured.entries):
            self.correct(measured)

    def add_curvature(self, tick: Tick, measured: UsableMeasurements) -> None:
        """Set the variances of second-order errors of the measurements of other sensors than the camera."""
        number, frames = measured.entries["sensor"], np.zeros(len(measured.entries))
        for sensor in {*number.tolist()} - {CAMERA}:
            passed = max(tick.time - self.measured.get(sensor, 0.0), tick.dt)
            frames[number == sensor] = max(CURVATURE_TIME / passed, 1.0)
            self.measured[sensor] = tick.time
        linear, axes, line = linearised(self.state, measured), measured.axes, measured.positions - self.state.p
        G = linear.by_target[..., 3:] @ axes.swapaxes(1, 2)
        found = curvature(G, linear.angle, line, self.covariances_of_lines(measured, axes), frames)
        measured.entries["curvature"][:, : found.shape[1]] += found

    def covariances_of_lines(self, measured: UsableMeasurements, axes: Array) -> Array:
        """Return (m, 3, 3) the covariances of the lines from the vehicle to its targets, map axes, m^2."""
        of_targets = measured.weight * measured.entries["covariance"][:, 3:, 3:]
        return self.state.point_covariance(np.zeros(3)) + axes @ of_targets @ axes.swapaxes(1, 2)

    def judged(self, measured: UsableMeasurements) -> Judgement:
        """Return how measurements are judged at the estimate."""
        judgement: Judgement = judged_frame(*self.state, measured.frame, NO_CONSTANTS, NO_CROSSES, NO_PLACES)
        return judgement

    def correct(self, measured: UsableMeasurements) -> None:
        """Correct by measurements."""
        self.nis, self.nis_dof = self.fuse(measured)

    def correct_in_turn(self, measured: UsableMeasurements, known: NDArray[np.bool_]) -> None:
        """Correct by the measurements of a mask (m,) at once, then by the others, of neighbours, one at a time."""
        if known.any():
            self.nis, self.nis_dof = self.fuse(measured.only(known))
        for n in np.flatnonzero(~known).tolist():
            self.fuse_neighbour(measured.only(slice(n, n + 1)))

    def fuse_neighbour(self, one: UsableMeasurements) -> None:
        """Correct by one measurement of a neighbour."""
        self.fuse(one)

    def fuse(self, measured: UsableMeasurements) -> tuple[float, int]:
        """Correct by measurements; return their normalised innovation squared and their number of rows."""
        *pose, nis, dof = updated(*self.state, measured.frame)
        self.state = UncertainPose(self.kind, *pose)
        return float(nis), dof


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

    def fuse(self, measured: UsableMeasurements) -> tuple[float, int]:
        """Correct by measurements, linearised anew until convergence; return what `Mekf.fuse` returns."""
        before, distance = self.state, float(lengths(measured.positions - self.state.p).min())
        look = look_from(before, measured)
        dx, P, nis, dof = iterated(before.P, look, lambda dx: turn_of_sight(dx, distance))
        self.state = before.corrected(dx, P)
        return nis, dof


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

    def take(self, tick: Tick, measured: UsableMeasurements) -> None:
        """Correct by the measurements that pass the gate."""
        P, xi = self.state.P, sigma_points(self.state.P)
        linear = linearised(self.state, measured)
        if len(measured.sensors) == 1:
            mean, S, y = unscented(self.state.R, self.state.p, xi, linear.N, measured.frame)
        else:
            mean, S, y = moments(self.deviations(xi, measured, linear), linear)
        r = linear.residual.ravel() - mean
        if self.gated:
            each, rows = np.arange(len(measured.entries)), linear.residual.shape[1]
            blocks = S.reshape(len(each), rows, len(each), rows)[each, :, each, :]
            judgement = judged(r.reshape(-1, rows), blocks, *linear[4:8])
            fits = self.gate.passed(tick.time, judgement)
            kept, linear = fits.repeat(rows), linear.only(fits)
            if not kept.any():
                return
            if not kept.all():
                S, y, r = S[np.ix_(kept, kept)], y[:, kept], r[kept]
        solved = solve(S, np.concatenate([WEIGHT * y.T.dot(xi), r[:, None]], axis=1))
        gain = solved[:, :-1].T
        P = P - gain.dot(S).dot(gain.T)
        self.state = self.state.moved(gain.dot(r), (P + P.T) / 2)
        self.nis, self.nis_dof = float(r.dot(solved[:, -1])), int(linear.used.sum())

    def deviations(self, xi: Array, measured: UsableMeasurements, linear: LinearMeasurements) -> Array:
        """Return (k, rm) by how much predictions at sigma points xi (k, 6) exceed the one at the mean."""
        at = [linearised(self.state.moved(x, self.state.P), measured).residual for x in xi]
        return np.array([(linear.residual - residual).ravel() for residual in at])


def moments(y: Array, linear: LinearMeasurements) -> tuple[Array, Array, Array]:
    """Return mean (n,) and covariance (n, n) of values (k, n) at the sigma points, and their deviations (k, n)."""
    mean, N, used = WEIGHT * y.sum(axis=0), np.eye(y.shape[1]), linear.used.ravel()
    N[np.ix_(used, used)] = linear.stacked()[2]
    y = y - mean
    return mean, N + MEAN_WEIGHT * np.outer(mean, mean) + WEIGHT * y.T.dot(y), y


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
    positions, lever_arm = frame[0].position, frame[1].position[CAMERA]
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


MOST_TRIPLES = 20
ITERATIONS = 8
CONVERGED = 1e-2  # squared length of a step in standard deviations
LONGEST_TURN = 1.0  # rad, of a step
BEARING_GATE = 25.0  # squared residual of a bearing over its variance, (5 sigma)^2
POSE_GATE = 45.0
"""Squared distance to the predicted pose over its variance; chi-square with 6 degrees of freedom beyond it: 5e-8."""
PATIENCE = 1.0  # s for which bearings must contradict the predicted pose before a pose far from it is accepted
NARROW_STD = 0.5
"""rad, of the predicted orientation: below it Gauss-Newton from there finds the pose near it."""
LARGEST_STD = 0.15
"""Largest standard deviation of the position over the distance to the nearest point; beyond it geometry is weak."""

ALL = np.eye(6)
ADJUGATE = np.array([[1.0, -1.0], [-1.0, 1.0]])


class PerspectivePoints(PoseObserver):
    """A pose per frame from three bearings, no memory.

    With fewer bearings it adds odometry. It sends position and covariance.

    The pose is from the bearings of one frame (P3P, PnP); odometry carries it to the next one, and counts no further.

    Source: candidates by p3p.py; among them the one that agrees with most bearings, then the one nearest to the pose
    predicted by odometry (Fischler and Bolles, Random sample consensus, Communications of the ACM 24(6), 1981, with all
    triples in place of random ones); then Gauss-Newton over all bearings that agree. Where Gauss-Newton from the
    predicted pose ends at a pose that fits, that is the candidate nearest to it, and the closed form is not needed.
    """

    def reset(self, initial_pose: tuple[Array, Array], initial_covariance: Array) -> None:
        """Start at a pose."""
        super().reset(initial_pose, initial_covariance)
        self.contradicted = 0.0

    def update(self, tick: Tick) -> Estimate:
        """Append the increment, and replace the pose by that of the frame where it has one."""
        self.state = self.state.predicted(tick)
        seen = usable_measurements(tick) if tick.due else None
        if seen is not None and len((bearings := seen.of_camera()).entries) >= 3:
            self.take(tick, bearings)
        return self.state.estimate()

    def take(self, tick: Tick, data: UsableMeasurements) -> None:
        """Take the pose of a frame if it is accepted."""
        found = refined(self.state, data)
        if found is None or distance(found, self.state) > POSE_GATE:
            expected = (misfits(self.state, data, self.state.P) < BEARING_GATE).all()
            self.contradicted = 0.0 if expected else self.contradicted + tick.dt
            if expected and self.state.P[0, 0] + self.state.P[1, 1] + self.state.P[2, 2] < NARROW_STD**2:
                return  # weak geometry at a plausible pose
            found = self.chosen(data)
        if found is not None and (distance(found, self.state) < POSE_GATE or self.contradicted > PATIENCE):
            self.state, self.contradicted = found, 0.0

    def chosen(self, data: UsableMeasurements) -> UncertainPose | None:
        """Return the candidate that agrees with most bearings, then the one nearest to the predicted pose."""
        best, most, nearest = None, 3, inf
        triples = np.array([*islice(combinations(range(len(data.bearings)), 3), MOST_TRIPLES)])
        turns, cameras, mask = solve_p3p(data.bearings[triples], data.positions[triples])
        lever_arm = data.sensors["position"][CAMERA]
        for R, camera in zip(turns[mask], cameras[mask], strict=True):
            start = UncertainPose(LEFT, R, camera - R @ lever_arm, self.state.P)
            agrees = misfits(start, data) < BEARING_GATE
            if (count := int(agrees.sum())) < most:
                continue
            pose = refined(start, data.only(agrees))
            if pose is not None and (count > most or distance(pose, self.state) < nearest):
                best, most, nearest = pose, count, distance(pose, self.state)
        return best


def misfits(pose: UncertainPose, data: UsableMeasurements, P: Array | None = None) -> Array:
    """Return (m,) the squared residuals over their variance, infinite for bearings from behind.

    With P, the variance is that given a pose with this covariance.
    """
    linear = linearised(pose, data)
    residual, H, N = linear[:3]
    if P is not None:
        N = N + H @ P @ H.transpose(0, 2, 1)
    return np.where(linear.ahead, normalised(residual, N), inf)


def refined(start: UncertainPose, data: UsableMeasurements) -> UncertainPose | None:
    """Return the least-squares pose near a start with its covariance, None where it fails, misfits or is too weak."""
    pose = start
    for _ in range(ITERATIONS):
        residual, H, N, *_ = linearised(pose, data)
        determinants = N[:, 0, 0] * N[:, 1, 1] - N[:, 0, 1] * N[:, 0, 1]
        weighted = (N[:, ::-1, ::-1] * ADJUGATE / determinants[:, None, None] @ H).reshape(-1, 6)
        try:
            P = solve(H.reshape(-1, 6).T.dot(weighted), ALL)
        except np.linalg.LinAlgError:
            return None
        gradient = residual.ravel().dot(weighted)
        step = P.dot(gradient)
        nearest = sqrt(((data.positions - pose.p) ** 2).sum(1).min())
        firm = 0.0 < P[3, 3] + P[4, 4] + P[5, 5] < (LARGEST_STD * nearest) ** 2  # else geometry is too weak
        if not (step[:3].dot(step[:3]) < LONGEST_TURN**2 and firm):  # NaN fails as well
            return None
        pose = pose.moved(step, (P + P.T) / 2)
        if step.dot(gradient) < CONVERGED:
            ahead = linearised(pose, data).ahead
            fits = ahead & (normalised(residual - H @ step, N) < BEARING_GATE)
            return pose if fits.all() else None
    return None


def distance(pose: UncertainPose, predicted: UncertainPose) -> float:
    """Return the squared Mahalanobis distance of two poses whose errors are independent.

    The rotation counts by twice the vector part of its quaternion.
    """
    tilde = predicted.R.T.dot(pose.R)
    vector = np.array([tilde[2, 1] - tilde[1, 2], tilde[0, 2] - tilde[2, 0], tilde[1, 0] - tilde[0, 1]])
    e = np.concatenate([vector / sqrt(max(1.0 + tilde.trace(), 1e-9)), predicted.R.T.dot(pose.p - predicted.p)])
    return float(e.dot(solve(pose.P + predicted.P, e)))


class DeadReckoning(PoseObserver):
    """Adds up odometry and sends nothing.

    Source: composition of the increments; covariance as in the prediction of the left-error filter.
    """

    def update(self, tick: Tick) -> Estimate:
        """Append the increment."""
        self.state = self.state.predicted(tick)
        return self.state.estimate()

    def message(self) -> Message:
        """Return an empty message."""
        return Message()
