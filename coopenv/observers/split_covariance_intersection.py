"""Error-state filter that fuses neighbours by split covariance intersection.

Source: Li, Nashashibi and Yang, Split covariance intersection filter: theory and its application to vehicle
localization, IEEE Transactions on Intelligent Transportation Systems 14(4), 2013; Li and Nashashibi, Cooperative
multi-vehicle localization using split covariance intersection filter, IEEE Intelligent Transportation Systems Magazine
5(2), 2013. The covariance is the sum of a part of errors that others may share and one of errors that are one's own,
P = P_d + P_i. Odometry: P_d <- F P_d F^T, P_i <- F P_i F^T + Q. A measurement with R_d and R_i:

    P_1 = P_d / w + P_i,  P_2 = R_d / (1 - w) + R_i,  K = P_1 H^T (H P_1 H^T + P_2)^-1,  P+ = (I - K H) P_1,
    P_i+ = (I - K H) P_i (I - K H)^T + K R_i K^T,  P_d+ = P+ - P_i+,  w minimises det P+.

A landmark has R_d = 0. Of a bearing to a neighbour the noise is R_i, and the neighbour's covariance is R_d, both parts
of it: what is its own when it tells it has been told before, and is shared from then on. (Were its independent part
taken for independent each time, nobody downstream of one leader would ever have a dependent part, and the filter would
be mekf_covariance.) That P_i is independent of what others tell holds as long as nobody hears of itself: it is an
assumption where vehicles see each other in a circle.
"""

from dataclasses import replace

import numpy as np

from coopenv.estimation.arrays import Array
from coopenv.estimation.compiled import MATRIX, NUMBER, VECTOR, WHOLE, compiled
from coopenv.estimation.compiled_matrices import congruent
from coopenv.observers.contract import Tick
from coopenv.observers.correction import joseph
from coopenv.observers.lines import Lines, Sight, linearised
from coopenv.observers.mekf import Mekf
from coopenv.observers.pose_errors import corrected, recentring
from coopenv.observers.pose_update import FRAME, Frame, frame_of, halfway_gain

WEIGHTS = np.concatenate([[0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8], 1.0 - np.logspace(-1.0, -6.0, 16)])
"""Among which w is searched: near one as finely as at 60 Hz a little inflation adds up."""


@compiled(MATRIX)
def _det(A: Array) -> float:
    """Return the determinant of (2, 2)."""
    result: float = A[0, 0] * A[1, 1] - A[0, 1] * A[1, 0]
    return result


@compiled(MATRIX)
def log_determinant(P: Array) -> float:
    """Return log det P of a positive definite matrix, by elimination; not a number where it is none."""
    rest, total = P.copy(), 0.0
    for k in range(len(P)):
        total += np.log(rest[k, k])
        for i in range(k + 1, len(P)):
            factor = rest[i, k] / rest[k, k]
            for j in range(k + 1, len(P)):
                rest[i, j] -= factor * rest[k, j]
    return total


@compiled(MATRIX, MATRIX, MATRIX, MATRIX, NUMBER)
def best_weight(P_d: Array, P_i: Array, H: Array, N: Array, variance: float) -> float:
    """Return the w with the least det P+ = det P_1 det P_2 / det(H P_1 H^T + P_2), 1 if there is no gain.

    N is R_d + R_i, where R_i has a variance.
    """
    R_i = variance * np.eye(2)
    R_d = N - R_i
    best, least = 1.0, log_determinant(P_d + P_i)
    for w in WEIGHTS:
        P_1, P_2 = P_d / w + P_i, R_d / (1.0 - w) + R_i
        cost = log_determinant(P_1) + np.log(_det(P_2) / _det(congruent(H, P_1) + P_2))
        if cost < least:
            best, least = w, cost
    return best


@compiled(WHOLE, MATRIX, VECTOR, MATRIX, MATRIX, FRAME)
def updated_parts(
    kind: int, R: Array, p: Array, P: Array, P_i: Array, frame: Frame
) -> tuple[Array, Array, Array, Array, float]:
    """Return pose, P, P_i and r^T S^-1 r of a correction of a prediction of covariance P."""
    K, H, N, dx, nis = halfway_gain(kind, R, p, P, frame)
    P_i = congruent(recentring(kind, dx), joseph(P_i, K, H, frame[4] * np.eye(len(H))))
    R, p, P = corrected(kind, R, p, dx, joseph(P, K, H, N))
    return R, p, P, P_i, nis


class SplitCovarianceIntersection(Mekf):
    """Kalman filter; neighbours by split intersection.

    It sends position and covariance. It tells the normalised innovation of the landmarks.
    """

    sends_covariance = True

    def reset(self, initial_pose: tuple[Array, Array], initial_covariance: Array) -> None:
        """Start at a pose, whose errors are one's own."""
        super().reset(initial_pose, initial_covariance)
        self.independent = self.state.P.copy()  # P_i

    def predict(self, tick: Tick) -> None:
        """Append the increment to the pose and to both parts."""
        self.independent = replace(self.state, P=self.independent).predicted(tick).P
        super().predict(tick)

    def correct(self, tick: Tick, sight: Sight, lines: Lines) -> None:
        """Correct by the landmarks, then by neighbours one at a time."""
        known = np.array([m is None or m.covariance is None for m in sight.messages])
        if known.any():
            self.nis = self.intersect(tick, sight.only(known))
            self.nis_dof = 2 * int(known.sum())
        for n in np.flatnonzero(~known).tolist():
            self.intersect(tick, sight.one(n))

    def intersect(self, tick: Tick, sight: Sight) -> float:
        """Correct by bearings to landmarks, or by one to a neighbour; return the normalised innovation squared."""
        state, P, P_i = self.state, self.state.P, self.independent
        if sight.covariances.any():
            lines = linearised(state, tick, sight)
            w = best_weight(P - P_i, P_i, lines.H[0], lines.N[0], tick.noise.bearing_std**2)
            if w == 1.0:
                return 0.0
            P = (P - P_i) / w + P_i
            sight = sight._replace(covariances=sight.covariances / (1.0 - w))
        R, p, P, P_i, nis = updated_parts(state.kind, state.R, state.p, P, P_i, frame_of(tick, sight))
        self.state, self.independent = self.belief(R, p, P), P_i
        return float(nis)
