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
from coopenv.observers.contract import Tick
from coopenv.observers.correction import gain, joseph
from coopenv.observers.lines import Lines, Sight, linearised
from coopenv.observers.mekf import Mekf

WEIGHTS = np.concatenate([[0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8], 1.0 - np.logspace(-1.0, -6.0, 16)])
"""Among which w is searched: near one as finely as at 60 Hz a little inflation adds up."""


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
        for n in np.flatnonzero(~known):
            self.intersect(tick, sight.only(np.arange(len(known)) == n))

    def intersect(self, tick: Tick, sight: Sight) -> float:
        """Correct by bearings to landmarks, or by one to a neighbour; return the normalised innovation squared."""
        before, P_i, variance = self.state, self.independent, tick.noise.bearing_std**2
        lines = linearised(before, tick, sight)
        R_i, P = variance * np.eye(2 * len(lines.N)), before.P
        if sight.covariances.any():
            w = best_weight(P - P_i, P_i, lines.H[0], lines.N[0] - R_i, R_i)
            if w == 1.0:
                return 0.0
            P = (P - P_i) / w + P_i
            sight = sight._replace(covariances=sight.covariances / (1.0 - w))
            lines = lines._replace(N=lines.weighed(tick.noise.bearing_std, 1.0 / (1.0 - w)))
        residual, H, N = lines.stacked()
        _, dx, nis = gain(P, H, N, residual)
        at = 0.5 * dx  # half way, see correction.py
        residual, H, N = linearised(before.moved(at, P), tick, sight).stacked()
        H = H.dot(before.recentring(at))
        K, dx, _ = gain(P, H, N, residual + H.dot(at))
        self.state = before.corrected(dx, joseph(P, K, H, N))
        self.independent = before.corrected(dx, joseph(P_i, K, H, R_i)).P
        return nis


def best_weight(P_d: Array, P_i: Array, H: Array, R_d: Array, R_i: Array) -> float:
    """Return the w with the least det P+ = det P_1 det P_2 / det(H P_1 H^T + P_2), 1 if there is no gain."""
    w = WEIGHTS[:, None, None]
    P_1, P_2 = P_d / w + P_i, R_d / (1.0 - w) + R_i
    S = H @ P_1 @ H.T + P_2
    cost = np.linalg.slogdet(P_1)[1] + np.log(_det(P_2)) - np.log(_det(S))
    best = int(np.argmin(cost))
    return float(WEIGHTS[best]) if cost[best] < np.linalg.slogdet(P_d + P_i)[1] else 1.0


def _det(A: Array) -> Array:
    return np.asarray(A[:, 0, 0] * A[:, 1, 1] - A[:, 0, 1] * A[:, 1, 0])
