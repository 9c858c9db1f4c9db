"""Filters that consider the poses of their neighbours (Schmidt-Kalman), and the pairwise filter of Luft et al.

Source: Schmidt, Application of state-space methods to navigation problems, Advances in Control Systems 3, 1966; for
vehicles that consider each other, the cross-covariances of Roumeliotis and Bekey, Distributed multirobot localization,
IEEE Transactions on Robotics and Automation 18(5), 2002. The own pose and those of the neighbours in view are one
state, in which the gain of the neighbours is zero. The cross-covariances between two neighbours are received: each
vehicle sends those that it keeps with its own neighbours.

The error of a neighbour j is that of its marker's reported pose, R_j = Rhat_j Exp(theta), z_j = zhat_j + Rhat_j rho.
C_ij is its covariance with the own error. The own error changes by F (odometry) and by P+ P-^-1 (bearings). The product
of these since the last message is the vehicle's factor. It is sent, so that a neighbour propagates its C_ij by C_ij <-
C_ij factor_j^T. For lost messages the received factor stands in. Source of this rule: Luft, Schubert, Roumeliotis and
Burgard, Recursive decentralized localization for multi-robot systems with asynchronous pairwise communication,
International Journal of Robotics Research 37(10), 2018. It is exact for odometry and landmarks. For bearings to a third
vehicle it holds if that vehicle correlates with j only by way of i.

Behind the pose the own error has the lasting errors that the vehicle's noise and sensors declare. Those in `estimated`
are corrected, the others are considered, too. So are the errors of the map: a landmark with a standard deviation is a
neighbour that does not move, whose error is the same for all vehicles. Its cross-covariance with a neighbour is the one
that the neighbour has sent.

Two neighbours of which neither has sent their cross-covariance count as independent given the others in view that both
correlate with: C_ab = C_aS P_SS^-1 C_Sb. That is the covariance of largest entropy with the known blocks. Source:
Dempster, Covariance selection, Biometrics 28(1), 1972. Zeros would state that errors with a common cause are
independent.

In that work a measurement corrects both vehicles, which exchange covariances and factors both ways. Here messages are
broadcast, and the target of a bearing does not receive it: j is considered, and only i is corrected. The product
Sigma_ij is kept by i and propagated by j's factor.
"""

from collections.abc import Collection, Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from coopenv.estimation.compiled import (
    MATRIX,
    NUMBER,
    VECTOR,
    WHOLE,
    adjoint,
    compiled,
    congruent,
    eliminated,
    place,
    product,
)
from coopenv.estimation.poses import Array, cholesky, solve
from coopenv.observers.contract import Message, Setup, Tick
from coopenv.observers.correction import (
    CONSTANTS,
    PLACES,
    Constants,
    Judgement,
    halfway_gain,
    joseph,
    judged_frame,
)
from coopenv.observers.frame import FRAME, Frame, UsableMeasurements
from coopenv.observers.joint_gate import fitting_together, innovation, largest_of
from coopenv.observers.lasting_errors import EVERY, LastingErrors
from coopenv.observers.pose_filters import Mekf
from coopenv.observers.uncertain_pose import LEFT, UncertainPose, increment, moved, predicted, recentring, transition

MOST_LOST = 60  # lost messages in a row that a received factor may stand for
SHRINKING = (0.98, 0.9, 0.7, 0.4, 0.0)
"""Factors on cross-covariances that make the joint covariance positive definite, if the received ones do not."""


class ConsideredNeighbour(NamedTuple):
    """The last report of a neighbour, and its covariance with the own error."""

    number: int  # of its last message
    P: Array  # (6, 6) as reported, about its marker
    cross: Array  # (n, 6) C_ij


LEAST_VARIANCE = 1e-12  # rad^2, of a landmark's orientation, which counts as known


class ConsiderFilter(Mekf):
    """Base of the filters that keep cross-covariances; the own error is a left one, and the lasting errors behind it.

    `estimated` names lasting errors that the filter estimates (`lasting_errors.EVERY`); it considers the others.
    """

    sends_covariance = True
    guarded = True
    jointly = True  # whether measurements of a frame must also fit together
    counts_errors = False
    estimated: ClassVar[Collection[str]] = ()

    def __init__(self, setup: Setup) -> None:
        super().__init__(setup)
        marker = np.asarray(setup.marker, float)
        self.to_marker = adjoint(np.eye(3), -marker)  # own left error to that of the marker's pose
        self.from_marker = adjoint(np.eye(3), marker)
        self.landmarks = setup.landmarks
        self.lasting = LastingErrors(setup, self.estimated)
        self.map_covariances = {
            n: np.diag([*[LEAST_VARIANCE] * 3, *[std**2] * 3])
            for n, std in enumerate(setup.landmark_std)
            if std > 0.0 and n in setup.targets
        }

    def reset(self, initial_pose: tuple[Array, Array], initial_covariance: Array) -> None:
        """Start at a pose that is independent of the other vehicles and of the map, with lasting errors of zero."""
        super().reset(initial_pose, initial_covariance)
        self.values = np.zeros(len(self.lasting.states))
        self.P = block_diag(self.state.P, np.diag(self.lasting.variances)) if len(self.values) else self.state.P
        self.lasting.reset()
        self.by_sensor = self.lasting.by_sensor()
        unknown = np.zeros((len(self.P), 6))
        self.neighbours = {n: ConsideredNeighbour(0, P, unknown) for n, P in self.map_covariances.items()}
        self.identity = np.eye(len(self.P))
        self.factor, self.number = self.identity, 0

    @property
    def covariance(self) -> Array:
        """(6 + c, 6 + c) covariance of the errors of the pose and of the lasting errors."""
        return self.P

    @property
    def constants(self) -> Constants:
        """The lasting errors."""
        return self.by_sensor, self.values, self.lasting.estimated

    def message(self) -> Message:
        """Return the marker's pose and covariance, and the factor since the last message with its number."""
        T = self.to_marker
        factor = T.dot(self.factor[:6, :6]).dot(self.from_marker)
        self.factor, self.number = self.identity, self.number + 1
        extra = {"factor": factor, "number": np.array([self.number]), **self.extra()}
        position = self.state.p + self.state.R.dot(self.marker)
        return Message(position, self.state.R, T.dot(self.stated.P).dot(T.T), extra)

    def predict(self, tick: Tick) -> None:
        """Append the increment without its lasting errors."""
        if not len(self.values):
            self.propagate_cross_covariances(transition(*increment(tick)))
            super().predict(tick)
            self.P = self.state.P
            return
        self.twist = tick.velocity, tick.angular_velocity
        step, noise, lasts = self.lasting.step(tick, self.values), tick.noise.odometry(tick.dt), self.lasting.lasts
        if self.lasting.late:
            self.by_sensor = self.lasting.by_sensor()
        A = self.identity.copy()
        A[:6, :6], A[:6, 6:], A[6:, 6:] = transition(step.rotation, step.translation), step.by_errors, np.diag(lasts)
        self.values = lasts * self.values
        self.propagate_cross_covariances(A)
        self.P = A.dot(self.P).dot(A.T) + np.diag([*noise, *self.lasting.noise(tick.dt)])
        R, p, _ = predicted(LEFT, self.state.R, self.state.p, self.state.P, step.rotation, step.translation, noise)
        self.state = UncertainPose(LEFT, R, p, self.P[:6, :6])

    def propagate_cross_covariances(self, A: Array, others: Sequence[int] | None = None) -> None:
        """Multiply the own error by A in the factor and in the cross-covariances with `others` (None: all)."""
        for j in self.neighbours if others is None else others:
            number, P, cross = self.neighbours[j]
            self.neighbours[j] = ConsideredNeighbour(number, P, A.dot(cross))
        self.factor = A.dot(self.factor)

    def take(self, tick: Tick, measured: UsableMeasurements) -> None:
        """Receive the reports of the vehicles that are measured, then correct."""
        for target, message in zip(measured.targets.tolist(), measured.messages, strict=True):
            if message is not None:
                self.receive(target, message)
        super().take(tick, measured)

    def judged(self, measured: UsableMeasurements) -> Judgement:
        """Return how measurements are judged at the estimate, cross-covariances included."""
        seen, places = self.places(measured)
        crosses = np.array([self.neighbours[t].cross for t in seen]).reshape(-1, len(self.covariance), 6)
        pose, frame = self.state[:3], measured.frame
        judgement: Judgement = judged_frame(*pose, self.covariance, frame, self.constants, crosses, places)
        return judgement

    def covariances_of_lines(self, measured: UsableMeasurements, axes: Array) -> Array:
        """Return those of `Mekf`, cross-covariances included."""
        V, (seen, places) = super().covariances_of_lines(measured, axes), self.places(measured)
        J = self.state.point_derivative(np.zeros(3))
        for n in np.flatnonzero(places >= 0).tolist():
            common = J.dot(self.neighbours[seen[places[n]]].cross[:6, 3:]).dot(axes[n].T)
            V[n] -= common + common.T
        return V

    def receive(self, target: int, message: Message) -> None:
        """Take the report of a neighbour, if it runs the same observer."""
        factor, number = (np.asarray(message.extra.get(name, np.nan)) for name in ("factor", "number"))
        if message.rotation is None or message.covariance is None or np.shape(message.covariance) != (6, 6):
            return
        if factor.shape != (6, 6) or number.shape != (1,) or factor.dtype.kind not in "biuf":
            return
        factor = factor.astype(float)
        of, now = self.neighbours.get(target), int(number[0])
        cross = np.zeros((len(self.covariance), 6)) if of is None else of.cross
        if of is not None and now != of.number:
            lost = max(1, min(now - of.number, MOST_LOST))
            cross = cross.dot(factor.T if lost == 1 else np.linalg.matrix_power(factor, lost).T)
        cross = bounded(cross, self.covariance, np.asarray(message.covariance, float))
        self.neighbours[target] = ConsideredNeighbour(now, message.covariance, cross)

    def fuse(self, measured: UsableMeasurements, between: Array | None = None) -> tuple[float, int]:
        """Correct by measurements of landmarks and of neighbours that are known; return what `Mekf.fuse` returns.

        `between` (n + u, n + u, 6, 6) holds the covariances of the neighbours with each other, in the order of `seen`,
        and after them those with the landmarks of `unseen`.
        """
        seen, places = self.places(measured)
        of, own = [self.neighbours[t] for t in seen], len(self.P)
        joint = made_definite(self.joint_covariance(seen, between), own)
        frame = measured.exact().frame
        made = self.considered(joint, frame, places)
        if self.jointly and not self.gate.is_open and made[6] > largest_of(made[7]):
            kept = fitting_together(*innovation(*self.state[1:3], joint, frame, self.constants, places), len(places))
            self.gate.refuse(int((~kept).sum()))
            made = self.considered(joint, (frame[0][kept], *frame[1:]), places[kept])
        R, p, P, change, remaining, crosses, nis, dof = made
        carried = factor_of(joint, remaining)
        for n, target in enumerate(self.unseen(seen), len(seen)):
            number, variances, cross = self.neighbours[target]
            if between is not None:
                cross = np.concatenate([cross, *between[n, : len(seen)].swapaxes(-1, -2)])
            after = remaining[:, : len(cross)].dot(cross)
            self.neighbours[target] = ConsideredNeighbour(number, variances, after)
        self.set_corrected(R, p, P, change)
        others = [t for t in self.neighbours if t not in seen and t >= self.landmarks]
        self.propagate_cross_covariances(carried, others)
        for target, was, cross in zip(seen, of, crosses, strict=True):
            self.neighbours[target] = ConsideredNeighbour(was.number, was.P, cross)
        return float(nis), dof

    def considered(self, joint: Array, frame: Frame, places: NDArray[np.int64]) -> "Considered":
        """Return the correction of the own error; arguments and result as for the function `considered`."""
        made: Considered = considered(self.state.R, self.state.p, joint, frame, self.constants, places)
        return made

    def set_corrected(self, R: Array, p: Array, P: Array, change: Array) -> None:
        """Set the corrected pose, the covariance (n, n) of the own error, and the change of the constants (n - 6,)."""
        self.state, self.P, self.values = UncertainPose(LEFT, R, p, P[:6, :6]), P, self.values + change

    def unseen(self, seen: Sequence[int]) -> list[int]:
        """Return the landmarks with errors that are not among the targets `seen`."""
        return [target for target in self.map_covariances if target not in seen]

    def seen(self, measured: UsableMeasurements) -> list[int]:
        """Return the known neighbours among the targets, each once."""
        return [target for target in dict.fromkeys(measured.targets.tolist()) if target in self.neighbours]

    def places(self, measured: UsableMeasurements) -> tuple[list[int], NDArray[np.int64]]:
        """Return the known neighbours among the targets, and (m,) which of them each measurement has, -1: none."""
        seen = self.seen(measured)
        return seen, np.array([seen.index(t) if t in seen else -1 for t in measured.targets.tolist()])

    def joint_covariance(self, seen: Sequence[int], between: Array | None = None) -> Array:
        """Return the joint covariance of the own error and those of neighbours; `between` as for `fuse`."""
        own = len(self.P)
        size = own + 6 * len(seen)
        joint = np.zeros((size, size))
        joint[:own, :own] = self.P
        for n, target in enumerate(seen):
            k, (_, P, cross) = slice(own + 6 * n, own + 6 * n + 6), self.neighbours[target]
            joint[k, k], joint[:own, k], joint[k, :own] = P, cross, cross.T
            if between is not None and n:
                joint[k, own : k.start] = between[n, :n].transpose(1, 0, 2).reshape(6, -1)
                joint[own : k.start, k] = joint[k, own : k.start].T
        if between is not None and len(seen) > 2:
            complete(joint, own, [target < self.landmarks for target in seen])
        return joint


def complete(joint: Array, own: int, still: Sequence[bool]) -> None:
    """Fill in the cross-covariances of two neighbours that are zero, by the others.

    Args:
        joint: (n + 6k, n + 6k) covariance of the own error and those of k neighbours; changed in place.
        own: n.
        still: (k,) which neighbours are landmarks; the errors of two landmarks are independent.
    """
    at = [slice(k, k + 6) for k in range(own, len(joint), 6)]
    known = np.asarray(joint[own:, own:].reshape(len(at), 6, len(at), 6).any(axis=(1, 3)))
    for a in range(len(at)):
        for b in range(a):
            between = np.flatnonzero(known[a] & known[b])
            if known[a, b] or not len(between) or (still[a] and still[b]):
                continue
            S = np.concatenate([np.arange(at[c].start, at[c].stop) for c in between])
            joint[at[a], at[b]] = joint[at[a], S].dot(solve(made_definite(joint[np.ix_(S, S)], 6), joint[S, at[b]]))
            joint[at[b], at[a]] = joint[at[a], at[b]].T


def made_definite(joint: Array, own: int) -> Array:
    """Return a joint covariance, with smaller cross-covariances if it is not positive definite."""
    if len(joint) == own or _has_factor(joint):
        return joint
    alone = block_diag(np.ones((own, own)), *[np.ones((6, 6))] * ((len(joint) - own) // 6))
    for factor in SHRINKING:
        shrunk: Array = joint * (alone + factor * (1.0 - alone))
        if _has_factor(shrunk):
            break
    return shrunk


Considered = tuple[Array, Array, Array, Array, Array, Array, float, int]


@compiled(MATRIX, VECTOR, WHOLE, WHOLE, MATRIX, MATRIX, MATRIX, MATRIX, VECTOR, NUMBER)
def considered_from(
    R: Array, p: Array, own: int, estimated: int, joint: Array, K: Array, whole: Array, N: Array, dx: Array, nis: float
) -> Considered:
    """Return the result of `considered` by that of `halfway_gain`: own errors, of which the first are estimated."""
    K, change = K.copy(), dx[6:own].copy()
    K[estimated:], change[estimated - 6 :] = 0.0, 0.0
    after = joseph(joint, K, whole, N)
    R, p = moved(LEFT, R, p, dx[:6])
    recentred = np.eye(own)
    place(recentred, 0, 0, recentring(LEFT, dx[:6]))
    P = congruent(recentred, after[:own, :own])
    remaining = product(recentred, np.eye(own, len(joint)) - product(K[:own], whole))
    crosses = np.empty(((len(joint) - own) // 6, own, 6))
    for n in range(len(crosses)):
        place(crosses[n], 0, 0, product(recentred, after[:own, own + 6 * n : own + 6 * n + 6]))
    return R, p, P, change, remaining, crosses, nis, len(N)


@compiled(MATRIX, MATRIX)
def factor_of(joint: Array, remaining: Array) -> Array:
    """Return the factor (n, n) of cross-covariances with others, from the joint covariance before a correction.

    `remaining` (n, n + 6k) is what remains of the errors before. Where all own errors are estimated it is P+ P-^-1.
    """
    own = len(remaining)
    return eliminated(joint[:own, :own], product(remaining, joint[:, :own]).T).T


@compiled(MATRIX, VECTOR, MATRIX, FRAME, CONSTANTS, PLACES)
def considered(R: Array, p: Array, joint: Array, frame: Frame, constants: Constants, places: Any) -> Considered:
    """Correct the own error, linearised half way (correction.py); neighbours are considered (Schmidt).

    Args:
        R: (3, 3) the own orientation.
        p: (3,) the own position.
        joint: (n + 6k, n + 6k) covariance of the own error and those of k neighbours.
        frame: the measurements; targets have no covariances.
        constants: of the sensors, n - 6 of them.
        places: (m,) the neighbour of each measurement, -1: none.

    Returns:
        Orientation, position, covariance (n, n), change of the constants (n - 6,), what remains (n, n + 6k) of the
        errors before in the own one, the cross-covariances with the neighbours (k, n, 6), r^T S^-1 r at the prediction,
        and the number of rows.
    """
    K, whole, N, dx, nis = halfway_gain(LEFT, R, p, joint, frame, constants, places)
    return considered_from(R, p, 6 + len(constants[1]), 6 + constants[2], joint, K, whole, N, dx, nis)


@compiled(MATRIX, MATRIX, MATRIX)
def bounded(cross: Array, P: Array, of: Array) -> Array:
    """Return a cross-covariance (n, m), clipped to correlations of at most 1."""
    result = np.zeros(cross.shape)
    for i in range(len(P)):
        for j in range(len(of)):
            limit = np.sqrt(max(P[i, i] * of[j, j], 0.0))
            if not np.isnan(cross[i, j]):
                result[i, j] = min(max(cross[i, j], -limit), limit)
    return result


def _has_factor(P: Array) -> bool:
    try:
        cholesky(P)
    except np.linalg.LinAlgError:
        return False
    return True


class SchmidtKalman(ConsiderFilter):
    """Considers neighbours with cross-covariances, lasting errors and the map.

    It sends its pose with covariance, its factor, and the cross-covariances that it keeps.
    """

    def message(self) -> Message:
        """Return pose, covariance and factor, and the cross-covariances with the neighbours."""
        report = super().message()
        targets = sorted(self.neighbours)
        cross = np.array([self.to_marker.dot(self.neighbours[t].cross[:6]) for t in targets]).reshape(-1, 6, 6)
        extra: dict[str, Array] = {**report.extra, "targets": np.array(targets, float), "cross": cross}
        return Message(report.position, report.rotation, report.covariance, extra)

    def correct(self, measured: UsableMeasurements) -> None:
        """Correct by all measurements at once."""
        messages = dict(zip(measured.targets.tolist(), measured.messages, strict=True))
        seen = self.seen(measured)
        known = [*seen, *self.unseen(seen)]
        between = np.zeros((len(known), len(known), 6, 6))
        for n, target in enumerate(known):
            for m, other in enumerate(seen[:n]):
                ours, its = messages.get(target), messages[other]
                if ours is not None or its is not None:
                    sent = sent_cross_covariance(ours, other), sent_cross_covariance(its, target)
                    between[n, m] = self.between(*sent)
        self.nis, self.nis_dof = self.fuse(measured, between)

    @staticmethod
    def between(by_one: Array, by_other: Array) -> Array:
        """Return the cross-covariance (6, 6) of two neighbours from what the two have sent; one of them knows it."""
        return by_one + by_other.T


class SchmidtKalmanIndividual(SchmidtKalman):
    """Considers neighbours, and tests each measurement alone.

    It is `schmidt_kalman` without the joint gate and without the guard of its covariance.
    """

    guarded = jointly = False


def sent_cross_covariance(message: Message | None, target: int) -> Array:
    """Return the sent cross-covariance (6, 6) of a sender with a target, zero if there is no message or it has none."""
    if message is None:
        return np.zeros((6, 6))
    targets, cross = (np.asarray(message.extra.get(name, ())) for name in ("targets", "cross"))
    if targets.ndim != 1 or cross.shape != (len(targets), 6, 6) or target not in (numbers := targets.tolist()):
        return np.zeros((6, 6))
    return np.asarray(cross[numbers.index(target)])


class SchmidtCalibrating(SchmidtKalman):
    """Schmidt filter that also estimates the lasting errors of its odometry and sensors.

    It sends what `schmidt_kalman` sends.
    """

    estimated = EVERY


class Pairwise(ConsiderFilter):
    """Keeps cross-covariances pair by pair.

    It sends its pose with covariance and its factor. The normalised innovation is that of the landmarks.
    """

    def correct(self, measured: UsableMeasurements) -> None:
        """Correct by the landmarks, then by neighbours one at a time."""
        known = [target < self.landmarks or target not in self.neighbours for target in measured.targets.tolist()]
        self.correct_in_turn(measured, np.array(known))
