"""Error-state filter that fuses neighbours by covariance intersection.

Source: Julier and Uhlmann, A non-divergent estimation algorithm in the presence of unknown correlations, 1997. For a
bearing to a neighbour P becomes P / w, and the neighbour's part of the noise H_j P_j H_j^T / (1 - w): the two may be
correlated in any way. The bearing's own noise is independent and stays whole. w minimises det P+. Consistent, at the
price of information. With the gain that is best for that bound it is also the discorrelated minimum variance of Zhu and
Kia, Cooperative localization under limited connectivity, IEEE Transactions on Robotics 35(6), 2019, for vehicles that
correct themselves alone. Unlike in split covariance intersection, P and P_j
count as dependent as a whole.

Source: Li, Nashashibi and Yang, Split covariance intersection filter: theory and its application to vehicle
localization, IEEE Transactions on Intelligent Transportation Systems 14(4), 2013; Li and Nashashibi, Cooperative
multi-vehicle localization using split covariance intersection filter, IEEE Intelligent Transportation Systems Magazine
5(2), 2013. The covariance is the sum of a part that may correlate with the errors of other vehicles and an independent
part, P = P_d + P_i. Odometry: P_d <- F P_d F^T, P_i <- F P_i F^T + Q. A measurement with R_d and R_i:

    P_1 = P_d / w + P_i,  P_2 = R_d / (1 - w) + R_i,  K = P_1 H^T (H P_1 H^T + P_2)^-1,  P+ = (I - K H) P_1,
    P_i+ = (I - K H) P_i (I - K H)^T + K R_i K^T,  P_d+ = P+ - P_i+,  w minimises det P+.

A landmark has R_d = 0. For a bearing to a neighbour, the noise is R_i and the whole covariance of the neighbour is R_d:
its independent part is shared from its first message on. (If it counted as independent in every message, no follower of
a single leader would have a dependent part, and the filter would be mekf_covariance.) P_i is independent of received
messages as long as a vehicle's own information does not return to it. In a circle of vehicles this is an assumption.
"""

from math import log

import numpy as np

from coopenv.estimation.compiled import MATRIX, NUMBER, VECTOR, WHOLE, compiled, congruent
from coopenv.estimation.poses import Array
from coopenv.observers.contract import Tick
from coopenv.observers.correction import NO_CONSTANTS, halfway_gain, joseph
from coopenv.observers.frame import FRAME, Frame, UsableMeasurements
from coopenv.observers.linearisation import linearise, linearised
from coopenv.observers.pose_filters import Mekf
from coopenv.observers.uncertain_pose import RIGHT, UncertainPose, corrected, recentring

LOWEST, HIGHEST = 0.02, 1.0 - 1e-6  # limits of w; 1 leaves the measurement out
CLOSE = 1e-9  # to which w is found
VAGUE = 10.0  # rad^2, of a bearing to a neighbour whose position is too uncertain to be used


@compiled(MATRIX, MATRIX)
def _mixed(A: Array, B: Array) -> float:
    """Return the factor m of det(x A + y B) = x^2 det A + x y m + y^2 det B, for symmetric (2, 2)."""
    result: float = A[0, 0] * B[1, 1] + A[1, 1] * B[0, 0] - 2.0 * A[0, 1] * B[0, 1]
    return result


@compiled(*[NUMBER] * 7)
def _f_and_g(w: float, o: float, t: float, p: float, ot: float, op: float, tp: float) -> tuple[float, float]:
    """Return f and g of `best_weight`."""
    v = 1.0 - w
    f = (v * o + ot) * v + t
    return f, w * w * f + v * (w * (v * op + tp) + v * p)


@compiled(MATRIX, MATRIX, MATRIX)
def best_weight(prior: Array, own: Array, theirs: Array) -> float:
    """Return the w in (0, 1] that minimises det P+, for covariances (2, 2) of a bearing.

    With v = 1 - w, N = own + theirs / v and the determinant lemma,
    log det P+ - log det P = -6 log w + log det N - log det(N + prior / w) = -4 log w + log f - log g, where
    f = det(v own + theirs) and g = det(w v own + w theirs + v prior). It is 0 at w = 1, and convex: the information
    w P^-1 + H^T N^-1 H is concave in w, N^-1 being a parallel sum, and so is log det. So its slope is bisected.
    """
    o, t, p = _mixed(own, own) / 2.0, _mixed(theirs, theirs) / 2.0, _mixed(prior, prior) / 2.0
    ot, op, tp = _mixed(own, theirs), _mixed(own, prior), _mixed(theirs, prior)
    low, high = LOWEST, HIGHEST
    while high - low > CLOSE:
        w = 0.5 * (low + high)
        v = 1.0 - w
        f, g = _f_and_g(w, o, t, p, ot, op, tp)
        by_f = -2.0 * v * o - ot
        by_g = 2.0 * w * f + w * w * by_f + (v - w) * (v * op + tp) - w * v * op - 2.0 * v * p
        if -4.0 / w + by_f / f - by_g / g < 0.0:
            low = w
        else:
            high = w
    f, g = _f_and_g(high, o, t, p, ot, op, tp)
    return high if -4.0 * log(high) + log(f / g) < 0.0 else 1.0


class CovarianceIntersection(Mekf):
    """Kalman filter; neighbours by covariance intersection.

    Landmarks come first, by a Kalman update, then neighbours one at a time. The normalised innovation is that of the
    landmarks; an inflated one has no known distribution.
    """

    sends_covariance = True

    def correct(self, measured: UsableMeasurements) -> None:
        """Correct by the landmarks, then by neighbours one at a time."""
        known = np.array([m is None or m.covariance is None for m in measured.messages])
        self.correct_in_turn(measured, known)

    def fuse_neighbour(self, one: UsableMeasurements) -> None:
        """Fuse one measurement of a neighbour with the covariance of its position."""
        state, linear = self.state, linearised(self.state, one)
        w = weight(state.P, linear.H[0], linear.N[0], linear.variance[0])
        if w < 1.0:
            self.state = state._replace(P=state.P / w)
            self.fuse(one.inflated(1.0 / (1.0 - w)))


class DistributedInvariant(CovarianceIntersection):
    """Invariant filter, right error; neighbours by covariance intersection.

    Source: Zhou, Liu, Zhu and Wang, Distributed invariant Kalman filter for cooperative localization using matrix Lie
    groups, arXiv 2405.04000: propagation on the group, absolute measurements by a Kalman update, relative ones by
    covariance intersection with the sender's covariance. There a robot has an inertial unit and measures relative
    positions; here it has odometry and measures bearings.
    """

    kind = RIGHT


WEIGHTS = np.concatenate([[0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8], 1.0 - np.logspace(-1.0, -6.0, 16)])
"""Values of w that are tried: fine steps near 1, because small inflations add up at 60 Hz."""


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


@compiled(MATRIX, MATRIX, MATRIX, MATRIX, MATRIX)
def best_split_weight(P_d: Array, P_i: Array, H: Array, N: Array, R_i: Array) -> float:
    """Return the w with the least det P+ = det P_1 det P_2 / det(H P_1 H^T + P_2), 1 if there is no gain.

    N is R_d + R_i.
    """
    R_d = N - R_i
    best, least = 1.0, log_determinant(P_d + P_i)
    for w in WEIGHTS:
        P_1, P_2 = P_d / w + P_i, R_d / (1.0 - w) + R_i
        S = congruent(H, P_1) + P_2
        if len(S) == 2:
            cost = log_determinant(P_1) + np.log(_mixed(P_2, P_2) / _mixed(S, S))
        else:
            cost = log_determinant(P_1) + log_determinant(P_2) - log_determinant(S)
        if cost < least:
            best, least = w, cost
    return best


@compiled(MATRIX, MATRIX, MATRIX, VECTOR)
def weight(P: Array, H: Array, N: Array, variances: Array) -> float:
    """Return w for one measurement, whose own noise has variances; 1 if the neighbour is too uncertain."""
    own = np.diag(variances)
    if len(N) == 2:
        return best_weight(congruent(H, P), own, N - own) if N[0, 0] + N[1, 1] < VAGUE else 1.0
    return best_split_weight(P, np.zeros((6, 6)), H, N, own)


@compiled(WHOLE, MATRIX, VECTOR, MATRIX, MATRIX, FRAME)
def updated_parts(
    kind: int, R: Array, p: Array, P: Array, P_i: Array, frame: Frame
) -> tuple[Array, Array, Array, Array, float, int]:
    """Return pose, P, P_i, r^T S^-1 r and the number of rows of a correction of a prediction of covariance P."""
    K, H, N, dx, nis = halfway_gain(kind, R, p, P, frame, NO_CONSTANTS, np.zeros(0, np.int64))
    variance, used = linearise(R, p, kind == RIGHT, frame)[4:6]
    R_i = np.diag(variance.ravel()[used.ravel()])
    P_i = congruent(recentring(kind, dx), joseph(P_i, K, H, R_i))
    R, p, P = corrected(kind, R, p, dx, joseph(P, K, H, N))
    return R, p, P, P_i, nis, len(N)


class SplitCovarianceIntersection(CovarianceIntersection):
    """Kalman filter; neighbours by split intersection.

    It sends position and covariance. The normalised innovation is that of the landmarks.
    """

    def reset(self, initial_pose: tuple[Array, Array], initial_covariance: Array) -> None:
        """Start at a pose with independent errors."""
        super().reset(initial_pose, initial_covariance)
        self.independent = self.state.P.copy()  # P_i

    def predict(self, tick: Tick) -> None:
        """Append the increment to the pose and to both parts."""
        self.independent = self.state._replace(P=self.independent).predicted(tick).P
        super().predict(tick)

    def fuse_neighbour(self, one: UsableMeasurements) -> None:
        """Fuse one measurement of a neighbour with the covariance of its position."""
        P, P_i, linear = self.state.P, self.independent, linearised(self.state, one)
        w = best_split_weight(P - P_i, P_i, linear.H[0], linear.N[0], np.diag(linear.variance[0]))
        if w < 1.0:
            self.state = self.state._replace(P=(P - P_i) / w + P_i)
            self.fuse(one.inflated(1.0 / (1.0 - w)))

    def fuse(self, measured: UsableMeasurements) -> tuple[float, int]:
        """Correct by measurements; return their normalised innovation squared and their number of rows."""
        *pose, self.independent, nis, dof = updated_parts(*self.state, self.independent, measured.frame)
        self.state = UncertainPose(self.kind, *pose)
        return float(nis), dof
