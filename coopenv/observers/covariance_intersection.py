"""Error-state filter that fuses neighbours by covariance intersection with what is told of them.

Source: Julier and Uhlmann, A non-divergent estimation algorithm in the presence of unknown correlations, 1997. For a
bearing to a neighbour P becomes P / w, and the neighbour's part of the noise H_j P_j H_j^T / (1 - w): the two may be
correlated in any way. The bearing's own noise is independent and stays whole. w minimises det P+. Consistent, at the
price of information. With the gain that is best for that bound it is also the discorrelated minimum variance of Zhu and
Kia, Cooperative localization under limited connectivity, IEEE Transactions on Robotics 35(6), 2019, for vehicles that
correct themselves alone. It is not split covariance intersection, which is in split_covariance_intersection.py: P and
P_j count as dependent as a whole.
"""

from math import log

import numpy as np

from coopenv.estimation.arrays import Array
from coopenv.estimation.compiled import MATRIX, NUMBER, compiled
from coopenv.estimation.compiled_matrices import congruent
from coopenv.observers.contract import Tick
from coopenv.observers.lines import Lines, Sight, linearised
from coopenv.observers.mekf import Mekf
from coopenv.observers.pose_update import frame_of, updated

LOWEST, HIGHEST = 0.02, 1.0 - 1e-6  # limits of w short of 1, which leaves the measurement out
CLOSE = 1e-9  # to which w is found
VAGUE = 10.0  # rad^2, of a bearing to a neighbour whose place is so uncertain that it says nothing


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


@compiled(MATRIX, MATRIX, MATRIX, NUMBER)
def weight(P: Array, H: Array, N: Array, variance: float) -> float:
    """Return w for one bearing whose own noise has a variance; 1 where the neighbour's place is too uncertain."""
    own = variance * np.eye(2)
    return best_weight(congruent(H, P), own, N - own) if N[0, 0] + N[1, 1] < VAGUE else 1.0


class CovarianceIntersection(Mekf):
    """Kalman filter; neighbours by covariance intersection.

    Landmarks come first, by a Kalman update, then neighbours one at a time.
    It tells the normalised innovation of the landmarks; an inflated one has no distribution.
    """

    sends_covariance = True

    def correct(self, tick: Tick, sight: Sight, lines: Lines) -> None:
        """Correct by bearings, which are linearised at the prediction."""
        known = np.array([m is None or m.covariance is None for m in sight.messages])
        if known.any():
            super().correct(tick, sight.only(known), lines.only(known))
        for n in np.flatnonzero(~known).tolist():
            self.intersect(tick, sight.one(n))

    def intersect(self, tick: Tick, one: Sight) -> None:
        """Fuse one bearing to a neighbour with the covariance of its position."""
        state, lines = self.state, linearised(self.state, tick, one)
        w = weight(state.P, lines.H[0], lines.N[0], tick.noise.bearing_std**2)
        if w < 1.0:
            inflated = one._replace(covariances=one.covariances / (1.0 - w))
            R, p, P, _ = updated(state.kind, state.R, state.p, state.P / w, frame_of(tick, inflated))
            self.state = self.belief(R, p, P)
