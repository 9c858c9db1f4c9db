"""The Kalman update of the zoo, with bearings linearised half way between prediction and correction.

For two vehicles with little relative motion, linearising at the predicted pose biases the estimated range outwards,
because gain and innovation depend on the same noise. Linearising half way between prediction and correction makes this
bias smaller (docs/explanation/robust.md#shown-by-experiment-the-point-of-linearisation compares the points).

The other form is iterated to convergence, which is Gauss-Newton: Bell and Cathey, The iterated Kalman
filter update as a Gauss-Newton method, IEEE Transactions on Automatic Control 38(2), 1993; with a line search as in
Skoglund, Hendeby and Axehill, Extended Kalman filter modifications based on an optimization view point, FUSION 2015.

Source: Bar-Shalom, Li and Kirubarajan, Estimation with applications to tracking and navigation, 2001, section 5.4: the
normalised innovation squared r^T S^-1 r of a correct bearing has a chi-square distribution of 2 degrees of freedom. S
contains the prior, the sender's covariance if the filter uses it, and the bearing's noise. The target must also be
ahead along the bearing (cheirality).

With a gate alone, a filter with a wrong pose and a small covariance rejects all bearings for ever. Trackers drop a
track without confirming measurements, and a new track is tentative until it is confirmed (Blackman and Popoli, Design
and analysis of modern tracking systems, 1999, chapter 6). Likewise this gate opens, which means that it accepts all
bearings, if the prior is too wide for linearised innovations or if most bearings are rejected. It closes when few
bearings would be rejected. Occasional wrong associations do not open it, nor does one faulty sender of two or more.
While the gate is open, a faulty message is fused.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numba import types
from numpy.typing import NDArray

from coopenv.estimation.compiled import (
    MATRICES,
    MATRIX,
    TARGET,
    VECTOR,
    WHOLE,
    compiled,
    eliminated,
    place,
    product,
    transformed,
)
from coopenv.estimation.poses import Array, solve
from coopenv.measurements.kinds import MOST_ROWS, unit
from coopenv.observers.frame import FRAME, Frame, UsableMeasurements
from coopenv.observers.guard import MOST_DEVIATIONS
from coopenv.observers.linearisation import (
    FLAG_ROWS,
    FLAGS,
    linearise,
    normalised,
    spread,
    stacked,
)
from coopenv.observers.uncertain_pose import RIGHT, UncertainPose, corrected, moved, recentring

CLOSE = 1e-3  # rad: largest turn of a line of sight by the last step
MOST = 8  # steps, and halvings of a step

Stacked = tuple[Array, Array, Array]
"""Residual (k,), its derivative H (k, n) by the error about the prediction, and its covariance N (k, k)."""

Look = Callable[[Array], Stacked]
"""Returns measurements linearised at the prediction moved by an error (n,)."""


@compiled(MATRIX, MATRIX, MATRIX, VECTOR)
def gain(P: Array, H: Array, N: Array, residual: Array) -> tuple[Array, Array, float]:
    """Return (K (n, k), dx (n,), r^T S^-1 r) of a Kalman update of P (n, n) by k numbers of covariance N (k, k)."""
    n, m = len(P), len(residual)
    H, right = np.ascontiguousarray(H), np.empty((m, n + 1))
    HP = H.dot(np.ascontiguousarray(P.T))
    place(right, 0, 0, HP)
    for k in range(m):
        right[k, n] = residual[k]
    solved = eliminated(HP.dot(H.T) + N, right)
    nis = 0.0
    for k in range(m):
        nis += residual[k] * solved[k, n]
    return solved[:, :n].T, transformed(solved[:, :n].T, residual), nis


@compiled(MATRIX, MATRIX, MATRIX, MATRIX)
def joseph(P: Array, K: Array, H: Array, N: Array) -> Array:
    """Return the covariance (n, n) after an update with any gain K (n, k)."""
    K = np.ascontiguousarray(K)
    A = np.eye(len(P)) - K.dot(np.ascontiguousarray(H))
    after: Array = A.dot(np.ascontiguousarray(P)).dot(A.T) + K.dot(np.ascontiguousarray(N)).dot(K.T)
    after = (after + after.T) / 2
    return after


def look_from(state: UncertainPose, measured: UsableMeasurements) -> Look:
    """Return measurements as a function of the own error about a predicted pose."""

    def look(at: Array) -> Stacked:
        pose, recentred = state.moved(at, state.P), recentring(state.kind, at)
        seen: Stacked = looked(*pose[:3], recentred, at, measured.frame, NO_CONSTANTS, NO_PLACES)
        return seen

    return look


def turn_of_sight(dx: Array, distance: float) -> float:
    """Return the angle, rad, by which an error (6n,) turns the line of sight to a point, given its distance in m."""
    size = np.abs(dx).reshape(-1, 2, 3).max(axis=(0, 2))
    return float(max(size[0], size[1] / distance))


def iterated(P: Array, look: Look, bend: Callable[[Array], float]) -> tuple[Array, Array, float, int]:
    """Return (dx, P+, r^T S^-1 r at the prediction, number of rows) of an update iterated to convergence.

    Steps are halved until the cost x^T P^-1 x + r^T N^-1 r falls. `bend` returns the angle by which an error (n,) turns
    a line of sight, rad.
    """

    def cost(x: Array, residual: Array, N: Array) -> float:
        return float(x.dot(solve(P, x)) + residual.dot(solve(N, residual)))

    at = np.zeros(len(P))
    residual, H, N = look(at)
    K, dx, nis = gain(P, H, N, residual)
    least = cost(at, residual, N)
    for _ in range(MOST):
        step = dx - at
        for _ in range(MOST):
            seen = look(at + step)
            reached = cost(at + step, seen[0], seen[2])
            if reached <= least:
                break
            step = 0.5 * step
        else:
            break
        at, least, (residual, H, N) = at + step, reached, seen
        K, dx, _ = gain(P, H, N, residual + H.dot(at))
        if bend(step) < CLOSE:
            break
    return at, joseph(P, K, H, N), nis, len(N)


def curvature(G: Array, angle: NDArray[np.bool_], line: Array, V: Array, frames: Array) -> Array:
    """Return the variances (m, r) of second-order errors that are the same in several frames.

    With errors s along the line of sight and t across it, a distance d has the error t^2 / 2d, and a direction has
    t s / d^2. A direction in which measurements hardly determine the place keeps its error for seconds. As white noise,
    the second-order error would average out, and the filter would be overconfident.

    Args:
        G: (m, r, 3) derivatives of the rows by the targets, map axes.
        angle: (m, r) rows that measure directions; the others measure distances.
        line: (m, 3) from the vehicle to the targets, map, m.
        V: (m, 3, 3) covariances of these lines, m^2.
        frames: (m,) which have the same error.
    """
    u, distance = unit(line)
    along = np.einsum("mi,mij,mj->m", u, V, u)[:, None]
    across = np.maximum(np.trace(V, axis1=1, axis2=2)[:, None] - along, 0.0)
    radial = np.einsum("mri,mi->mr", G, u) ** 2
    of_direction = np.maximum(along, 0.0) * across * (np.sum(G**2, axis=-1) - radial)
    variances = np.where(angle, of_direction, 0.5 * across**2 * radial)
    return np.asarray(frames[:, None] * variances / distance**2)


RISK = 1e-3  # that a correct measurement is refused
LARGEST = 13.8155  # 0.999 of a chi-square of 2: -2 log 0.001
LARGEST_OF = np.array([LARGEST, 10.828, LARGEST, 16.266, 18.467, 20.515, 22.458])
"""The same of as many degrees of freedom; a measurement without any row fits."""
WIDE = 0.5  # rad^2, trace of S: about 30 degrees per axis. Chosen
AVERAGING = 1.0  # s, over which the share of rejected bearings is averaged. Chosen
OPENING_SHARE, CLOSING_SHARE = 0.6, 0.1
"""Averaged shares of rejected bearings above which the gate opens, and below which it closes. Chosen: one wrong target
of two does not open the gate; one of three keeps it open."""


SECOND_ORDER = 0.75
"""Largest mean square of half the square of a normal error, over its squared variance: that of one axis."""


Judgement = tuple[NDArray[np.bool_], NDArray[np.bool_], float, float, Array]
"""(m,) which S are covariances, (m,) which measurements fit, the share of the others, the largest trace, rad^2, of the
rows that measure an angle, and (m, 3, r) the innovations as the guard takes them, second-order errors included."""


class InnovationGate:
    """Innovation gate of one vehicle."""

    def __init__(self) -> None:
        self.share = 0.0  # of rejected bearings, averaged
        self.is_open = False
        self.time = 0.0  # s, of the last frame
        self.weight = 0.0  # in the share, of one bearing of it

    def passed(self, time: float, judgement: Judgement) -> NDArray[np.bool_]:
        """Return (m,) which measurements of a frame are accepted; a measurement with an invalid S never is.

        Args:
            time: s.
            judgement: of the frame.
        """
        definite, fits, rejected, widest = judgement[:4]
        weight = min(1.0, max(0.0, time - self.time) / AVERAGING)
        self.share += (rejected - self.share) * weight
        self.weight = weight / len(fits)
        if widest > WIDE:
            self.share = 1.0
        self.time = time
        self.is_open = self.share > (CLOSING_SHARE if self.is_open else OPENING_SHARE)
        taken: NDArray[np.bool_] = definite if self.is_open else fits
        return taken

    def refuse(self, count: int) -> None:
        """Count so many accepted measurements of the last frame as rejected."""
        self.share += count * self.weight


@compiled(MATRIX, MATRICES, MATRIX, FLAG_ROWS, FLAG_ROWS, FLAGS)
def judged(
    residual: Array,
    S: Array,
    variance: Array,
    used: NDArray[np.bool_],
    angle: NDArray[np.bool_],
    ahead: NDArray[np.bool_],
) -> Judgement:
    """Return how measurements with covariances S (m, r, r) are judged; arguments as for `LinearMeasurements`."""
    squared, widest = normalised(residual, S), 0.0
    definite, fits = np.empty(len(S), np.bool_), np.empty(len(S), np.bool_)
    innovations = np.zeros((len(S), 3, residual.shape[1]))
    for n in range(len(S)):
        dof, trace = np.count_nonzero(used[n]), 0.0
        for k in range(residual.shape[1]):
            trace += S[n, k, k] if angle[n, k] else 0.0
        definite[n] = squared[n] >= 0.0 and dof > 0
        fits[n] = definite[n] and squared[n] <= LARGEST_OF[dof] and ahead[n]
        widest = max(widest, trace)
        for k in range(residual.shape[1]):
            if used[n, k] and definite[n]:
                of_row = S[n, k, k] + (SECOND_ORDER * trace * trace if angle[n, k] else 0.0)
                innovations[n, 0, k] = min(max(residual[n, k] / math.sqrt(of_row), -MOST_DEVIATIONS), MOST_DEVIATIONS)
                innovations[n, 1, k] = min(variance[n, k] / of_row, 1.0)
                innovations[n, 2, k] = math.sqrt(1.0 - innovations[n, 1, k])
    return definite, fits, 1.0 - np.count_nonzero(fits) / len(fits), widest, innovations


PLACES = types.Array(types.int64, 1, "A", readonly=True)


CONSTANTS = types.Tuple((MATRICES, VECTOR, WHOLE))
BY_POSE, BY_ROW, BY_VALUE, BY_TIME = slice(0, 6), slice(6, 6 + MOST_ROWS), 6 + MOST_ROWS, 7 + MOST_ROWS
Constants = tuple[Array, Array, int]
"""Constants behind the own pose in a state: what they change, by sensor (s, 8 + MOST_ROWS, c), their values (c,), and
how many of them, the first ones, are estimated; the others are considered.

They change measurements as a left error of the pose does (`BY_POSE`), rows (`BY_ROW`), the first row by a multiple
of the measured value (`BY_VALUE`), and all rows as the motion of the target over a time does (`BY_TIME`)."""
NO_CONSTANTS = np.zeros((1, BY_TIME + 1, 0)), np.zeros(0), 0
NO_PLACES, NO_CROSSES = np.zeros(0, np.int64), np.zeros((0, 6, 6))  # without neighbours


@compiled(TARGET, MATRIX, MATRIX, VECTOR, VECTOR)
def add_motion(columns: Array, by_target: Array, rotation: Array, velocity: Array, times: Array) -> None:
    """Add the motion of a target over times (c,), s per unit of a constant, to derivatives (r, c) by constants.

    Args:
        columns: changed in place.
        by_target: (r, 6) derivative by turn and shift of the target in its axes.
        rotation: (3, 3) its axes to the map; zero or NaN: those of the map.
        velocity: (3,) of it, map axes, m/s.
        times: how late it is measured, negative for the past.
    """
    shift = velocity.copy()
    if rotation[0, 0] ** 2 + rotation[1, 0] ** 2 + rotation[2, 0] ** 2 > 0.0:
        shift = transformed(rotation.T, velocity)
    rate = transformed(by_target[:, 3:], shift)
    for k in range(len(columns)):
        for c in range(len(times)):
            columns[k, c] += rate[k] * times[c]


@compiled(TARGET, MATRICES, MATRICES, FLAG_ROWS, FRAME, MATRIX, CONSTANTS, PLACES, WHOLE)
def joint_jacobian(
    residual: Array,
    H: Array,
    by_target: Array,
    used: NDArray[np.bool_],
    frame: Frame,
    recentring: Array,
    constants: Constants,
    places: Any,
    neighbours: int,
) -> Array:
    """Return (m, r, 6 + c + 6k) the derivative by the errors of the own pose, c constants, and k neighbours.

    Args:
        residual: (m, r), from which what constants explain is subtracted.
        H: (m, r, 6) by the error about where it is linearised.
        by_target: (m, r, 6) as in `LinearMeasurements`.
        used: (m, r) likewise.
        frame: the measurements.
        recentring: (6, 6) of the error of the own pose.
        constants: of the sensors.
        places: (m,) the neighbour of each measurement, -1: none; empty without neighbours.
        neighbours: k.
    """
    (m, r, _), (by_sensor, values, _) = H.shape, constants
    own = 6 + len(values)
    whole = np.zeros((m, r, own + 6 * neighbours))
    for n in range(m):
        place(whole[n], 0, 0, product(H[n], recentring))
        if own > 6:
            of = by_sensor[frame[0].sensor[n]]
            columns = product(H[n], of[BY_POSE]) + of[BY_ROW][:r]
            columns[0] += frame[0].value[n, 0] * of[BY_VALUE]
            if np.any(of[BY_TIME] != 0.0):
                add_motion(columns, by_target[n], frame[0].rotation[n], frame[0].velocity[n], of[BY_TIME])
            explained = transformed(columns, values)
            for k in range(r):
                if used[n, k]:
                    whole[n, k, 6:own] = columns[k]
                    residual[n, k] -= explained[k]
        if len(places) > 0 and places[n] >= 0:
            place(whole[n], 0, own + 6 * places[n], by_target[n])
    return whole


@compiled(WHOLE, MATRIX, VECTOR, MATRIX, VECTOR, FRAME, CONSTANTS, PLACES)
def looked(
    kind: int, R: Array, p: Array, recentring: Array, at: Array, frame: Frame, constants: Constants, places: Any
) -> Stacked:
    """Return residual (k,), H (k, n) and N (k, k), linearised at a pose that a prediction is moved to by errors (n,).

    H is the derivative by the errors about the prediction; `recentring` (6, 6) is theirs. The poses of neighbours stay
    as they are. The other arguments are those of `halfway_gain`.
    """
    by_sensor, values, estimated = constants
    own = 6 + len(values)
    residual, H, N, by_target, _, used, _, _ = linearise(R, p, kind == RIGHT, frame)
    moved_constants = by_sensor, values + at[6:own], estimated
    neighbours = (len(at) - own) // 6
    whole = joint_jacobian(residual, H, by_target, used, frame, recentring, moved_constants, places, neighbours)
    return stacked(residual, whole, N, by_target, used, frame)


@compiled(WHOLE, MATRIX, VECTOR, MATRIX, FRAME, CONSTANTS, PLACES)
def halfway_gain(
    kind: int, R: Array, p: Array, P: Array, frame: Frame, constants: Constants, places: Any
) -> tuple[Array, Array, Array, Array, float]:
    """Return (K (n, k), H, N, dx (n,), r^T S^-1 r at the prediction) of the correction of a prediction.

    H (k, n) and N (k, k) are those half way, where the poses of neighbours and considered constants stay as they are.

    Args:
        kind: of the own error.
        R: (3, 3) the own orientation.
        p: (3,) the own position.
        P: (n, n) covariance of the own error, of constants, and of the errors of some neighbours.
        frame: the measurements.
        constants: of the sensors.
        places: see `joint_jacobian`.
    """
    at = np.zeros(len(P))
    residual, H, N = looked(kind, R, p, np.eye(6), at, frame, constants, places)
    _, dx, nis = gain(P, H, N, residual)
    for n in range(6 + constants[2]):
        at[n] = 0.5 * dx[n]
    R, p = moved(kind, R, p, at[:6])
    residual, H, N = looked(kind, R, p, recentring(kind, at[:6]), at, frame, constants, places)
    K, dx, _ = gain(P, H, N, residual + transformed(H, at))
    return K, H, N, dx, nis


@compiled(WHOLE, MATRIX, VECTOR, MATRIX, FRAME, CONSTANTS, MATRICES, PLACES)
def judged_frame(
    kind: int, R: Array, p: Array, P: Array, frame: Frame, constants: Constants, crosses: Array, places: Any
) -> Judgement:
    """Return how measurements of a frame are judged at a prediction.

    P (n, n) is the covariance of the own error and of constants, and `crosses` (k, n, 6) are its covariances with the
    errors of some neighbours. The other arguments are those of `halfway_gain`.
    """
    residual, H, N, by_target, variance, used, angle, ahead = linearise(R, p, kind == RIGHT, frame)
    whole = joint_jacobian(residual, H, by_target, used, frame, np.eye(6), constants, np.zeros(0, np.int64), 0)
    S = spread(whole, P, N)
    for n in range(len(places)):
        if places[n] >= 0:
            common = product(product(whole[n], crosses[places[n]]), by_target[n].T)
            place(S[n], 0, 0, S[n] + common + common.T)
    return judged(residual, S, variance, used, angle, ahead)


@compiled(WHOLE, MATRIX, VECTOR, MATRIX, FRAME)
def updated(kind: int, R: Array, p: Array, P: Array, frame: Frame) -> tuple[Array, Array, Array, float, int]:
    """Return R (3, 3), p (3,) in m, P (6, 6), r^T S^-1 r and the number of rows of the correction of a prediction."""
    K, H, N, dx, nis = halfway_gain(kind, R, p, P, frame, NO_CONSTANTS, np.zeros(0, np.int64))
    R, p, P = corrected(kind, R, p, dx, joseph(P, K, H, N))
    return R, p, P, nis, len(N)
