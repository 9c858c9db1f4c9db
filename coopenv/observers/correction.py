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

from collections.abc import Callable
from typing import Any

import numpy as np
from numba import types
from numpy.typing import NDArray

from coopenv.estimation.compiled import (
    MATRICES,
    MATRIX,
    VECTOR,
    WHOLE,
    compiled,
    eliminated,
    place,
    product,
    transformed,
)
from coopenv.estimation.poses import Array, solve
from coopenv.measurements.kinds import unit
from coopenv.observers.contract import Tick
from coopenv.observers.frame import (
    FRAME,
    Frame,
    LinearMeasurements,
    UsableMeasurements,
    dense,
    frame_of,
    linearise,
    linearised,
    normalised,
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


def halfway(P: Array, look: Look, own: int = 6) -> tuple[Array, Array, Array, Array, float]:
    """Return (K, H, N, dx, r^T S^-1 r at the prediction) of a correction that is linearised half way.

    `halfway_gain` does the same for bearings. Errors after the `own` first stay as they are.
    """
    at = np.zeros(len(P))
    residual, H, N = look(at)
    _, dx, nis = gain(P, H, N, residual)
    at[:own] = 0.5 * dx[:own]
    residual, H, N = look(at)
    K, dx, _ = gain(P, H, N, residual + H.dot(at))
    return K, H, N, dx, nis


def look_from(state: UncertainPose, tick: Tick, measured: UsableMeasurements) -> Look:
    """Return measurements as a function of the own error about a predicted pose."""

    def look(at: Array) -> Stacked:
        residual, H, N = linearised(state.moved(at, state.P), tick, measured).stacked()
        return residual, H.dot(recentring(state.kind, at)), N

    return look


def corrected_pose(state: UncertainPose, tick: Tick, measured: UsableMeasurements) -> tuple[UncertainPose, float]:
    """Return a predicted pose corrected by measurements, and r^T S^-1 r at the prediction."""
    if measured.others is None:
        *pose, nis = updated(*state, frame_of(tick, measured))
        return UncertainPose(state.kind, *pose), float(nis)
    K, H, N, dx, nis = halfway(state.P, look_from(state, tick, measured))
    return state.corrected(dx, joseph(state.P, K, H, N)), nis


def turn_of_sight(dx: Array, distance: float) -> float:
    """Return the angle, rad, by which an error (6n,) turns the line of sight to a point, given its distance in m."""
    size = np.abs(dx).reshape(-1, 2, 3).max(axis=(0, 2))
    return float(max(size[0], size[1] / distance))


def iterated(P: Array, look: Look, bend: Callable[[Array], float]) -> tuple[Array, Array, float]:
    """Return (dx, P+, r^T S^-1 r at the prediction) of an update iterated to convergence.

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
    return at, joseph(P, K, H, N), nis


CURVATURE_TIME = 12.0
"""Time, s, in which all frames have the same second-order error. Tuned by `benchmarks.kinds` with ranges alone: with 0,
2, 12 and 30 s ANEES of `schmidt_kalman` is 2.0, 1.4, 1.0 and 0.8, and RMSE over the bound 1.3, 1.1, 1.1 and 1.1."""


def curvature(linear: LinearMeasurements, line: Array, V: Array, frames: Array) -> Array:
    """Return the variances (m, r) of second-order errors that are the same in several frames.

    With errors s along the line of sight and t across it, a distance d has the error t^2 / 2d, and a direction has
    t s / d^2. A direction in which measurements hardly determine the place keeps its error for seconds. As white noise,
    the second-order error would average out, and the filter would be overconfident.

    Args:
        linear: the measurements; rows of angles measure directions, the others distances.
        line: (m, 3) from the vehicle to the targets, map, m.
        V: (m, 3, 3) covariances of these lines, m^2.
        frames: (m,) which have the same error.
    """
    assert linear.angles is not None
    u, distance = unit(line)
    along = np.einsum("mi,mij,mj->m", u, V, u)[:, None]
    across = np.maximum(np.trace(V, axis1=1, axis2=2)[:, None] - along, 0.0)
    radial = np.einsum("mri,mi->mr", linear.G, u) ** 2
    of_direction = np.maximum(along, 0.0) * across * (np.sum(linear.G**2, axis=-1) - radial)
    variances = np.where(linear.angles, of_direction, 0.5 * across**2 * radial)
    return np.asarray(frames[:, None] * variances / distance**2)


LARGEST = 13.8155  # 0.999 of a chi-square of 2: -2 log 0.001
LARGEST_OF = np.array([LARGEST, 10.828, LARGEST, 16.266, 18.467, 20.515, 22.458])
"""The same of as many degrees of freedom; a measurement without any row fits."""
WIDE = 0.5  # rad^2, trace of S: about 30 degrees per axis. Chosen
AVERAGING = 1.0  # s, over which the share of rejected bearings is averaged. Chosen
OPENING_SHARE, CLOSING_SHARE = 0.6, 0.1
"""Averaged shares of rejected bearings above which the gate opens, and below which it closes. Chosen: one wrong target
of two does not open the gate; one of three keeps it open."""


class InnovationGate:
    """Innovation gate of one vehicle."""

    def __init__(self) -> None:
        self.share = 0.0  # of rejected bearings, averaged
        self.is_open = False
        self.time = 0.0  # s, of the last frame

    def passed(self, time: float, linear: LinearMeasurements, S: Array) -> NDArray[np.bool_]:
        """Return (m,) which measurements of a frame are accepted.

        Args:
            time: s.
            linear: the measurements.
            S: (m, r, r) covariances of their residuals; a measurement with an invalid one is never accepted.
        """
        bearings_alone = linear.used is None
        made = judged(linear.residual, S, linear.ahead) if bearings_alone else judged_of_all(linear, S)
        definite, fits, rejected, widest = made
        self.share += (rejected - self.share) * min(1.0, max(0.0, time - self.time) / AVERAGING)
        if widest > WIDE:
            self.share = 1.0
        self.time = time
        self.is_open = self.share > (CLOSING_SHARE if self.is_open else OPENING_SHARE)
        taken: NDArray[np.bool_] = definite if self.is_open else fits
        return taken


Judged = tuple[NDArray[np.bool_], NDArray[np.bool_], float, float]
"""(m,) which S are covariances, (m,) which measurements fit, the share of the others, and the largest trace, rad^2."""


@compiled(MATRIX, MATRICES, types.Array(types.boolean, 1, "A", readonly=True))
def judged(residual: Array, S: Array, in_front: NDArray[np.bool_]) -> Judged:
    """Return how bearings with residuals (m, 2) and their covariances (m, 2, 2) are judged."""
    squared = normalised(residual, S)
    definite = squared >= 0.0
    fits = definite & (squared <= LARGEST) & in_front
    widest = np.max(S[:, 0, 0] + S[:, 1, 1])
    return definite, fits, 1.0 - np.count_nonzero(fits) / len(fits), widest


def judged_of_all(linear: LinearMeasurements, S: Array) -> Judged:
    """Return the same of the measurements of any sensors; only angles are wide."""
    assert linear.used is not None and linear.angles is not None
    squared = np.einsum("mr,mr->m", linear.residual, np.linalg.solve(S, linear.residual[..., None])[..., 0])
    definite = (squared >= 0.0) & linear.used.any(axis=1)
    fits = definite & (squared <= LARGEST_OF[linear.used.sum(axis=1)]) & linear.ahead
    variances = np.where(linear.angles & linear.used, np.diagonal(S, axis1=1, axis2=2), 0.0)
    return definite, fits, 1.0 - float(fits.mean()), float(variances.sum(axis=1).max())


PLACES = types.Array(types.int64, 1, "A", readonly=True)


@compiled(MATRICES, MATRICES, MATRIX, MATRICES, PLACES)
def joint_jacobian(H: Array, G: Array, recentring: Array, turns: Array, places: Any) -> Array:
    """Return (rm, n + 6k) the derivative of m measurements by the own error and those of k neighbours' places.

    Args:
        H: (m, r, n) by the error about where it is linearised.
        G: (m, r, 3) by the points, map axes.
        recentring: (n, n) of the own error.
        turns: (k, 3, 3) the neighbours' orientations.
        places: (m,) the neighbour of each bearing, -1: none.
    """
    r, own = H.shape[1:]
    whole = np.zeros((r * len(H), own + 6 * len(turns)))
    for n in range(len(H)):
        place(whole, r * n, 0, product(H[n], recentring))
        k = places[n]
        if k >= 0:
            place(whole, r * n, own + 6 * k + 3, product(G[n], turns[k]))
    return whole


@compiled(WHOLE, MATRIX, VECTOR, MATRIX, FRAME, MATRICES, PLACES)
def halfway_gain(
    kind: int, R: Array, p: Array, P: Array, frame: Frame, turns: Array, places: Any
) -> tuple[Array, Array, Array, Array, float]:
    """Return (K (n, 2m), H, N, dx (n,), r^T S^-1 r at the prediction) of the correction of a prediction.

    H (2m, n) and N (2m, 2m) are those half way, where the poses of neighbours stay as they are.

    Args:
        kind: of the own error.
        R: (3, 3) the own orientation.
        p: (3,) the own position.
        P: (n, n) = (6 + 6k, 6 + 6k) covariance of the own error and those of k neighbours.
        frame: the bearings.
        turns: see `joint_jacobian`.
        places: see `joint_jacobian`.
    """
    residual, H, N, G, _ = linearise(R, p, kind == RIGHT, *frame)
    whole = joint_jacobian(H, G, np.eye(6), turns, places)
    _, dx, nis = gain(P, whole, dense(N), residual.ravel())
    at = 0.5 * dx
    at[6:] = 0.0
    R, p = moved(kind, R, p, at[:6])
    residual, H, N, G, _ = linearise(R, p, kind == RIGHT, *frame)
    whole = joint_jacobian(H, G, recentring(kind, at[:6]), turns, places)
    noise = dense(N)
    K, dx, _ = gain(P, whole, noise, residual.ravel() + transformed(whole, at))
    return K, whole, noise, dx, nis


@compiled(WHOLE, MATRIX, VECTOR, MATRIX, FRAME)
def own_gain(kind: int, R: Array, p: Array, P: Array, frame: Frame) -> tuple[Array, Array, Array, Array, float]:
    """Return the result of `halfway_gain` without neighbours."""
    return halfway_gain(kind, R, p, P, frame, np.zeros((0, 3, 3)), np.full(len(frame[1]), -1))


@compiled(WHOLE, MATRIX, VECTOR, MATRIX, FRAME)
def updated(kind: int, R: Array, p: Array, P: Array, frame: Frame) -> tuple[Array, Array, Array, float]:
    """Return R (3, 3), p (3,) in m, P (6, 6) and r^T S^-1 r of the correction of a prediction of covariance P."""
    K, H, N, dx, nis = own_gain(kind, R, p, P, frame)
    R, p, P = corrected(kind, R, p, dx, joseph(P, K, H, N))
    return R, p, P, nis
