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
from scipy.optimize import brentq

from coopenv.estimation.arrays import Array
from coopenv.observers.contract import Tick
from coopenv.observers.lines import PLANE, Lines, Sight, linearised
from coopenv.observers.mekf import Mekf

LOWEST, HIGHEST = 0.02, 1.0 - 1e-6  # limits of w short of 1, which leaves the measurement out
VAGUE = 10.0  # rad^2, of a bearing to a neighbour whose place is so uncertain that it says nothing


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
        for n in np.flatnonzero(~known):
            self.intersect(tick, sight.only(np.arange(len(known)) == n))

    def intersect(self, tick: Tick, one: Sight) -> None:
        """Fuse one bearing to a neighbour with the covariance of its position."""
        lines = linearised(self.state, tick, one)
        H, N = lines.H, lines.N
        own = tick.noise.bearing_std**2 * PLANE
        if not np.trace(N[0]) < VAGUE:
            return
        w = best_weight(H[0].dot(self.state.P).dot(H[0].T), own, N[0] - own)
        if w < 1.0:
            inflated = one._replace(covariances=one.covariances / (1.0 - w))
            lines = lines._replace(N=lines.weighed(tick.noise.bearing_std, 1.0 / (1.0 - w)))
            self.fuse(tick, inflated, lines, self.state.P / w)


def best_weight(prior: Array, own: Array, theirs: Array) -> float:
    """Return the w in (0, 1] that minimises det P+, for covariances (2, 2) of a bearing.

    With v = 1 - w, N = own + theirs / v and the determinant lemma,
    log det P+ - log det P = -6 log w + log det N - log det(N + prior / w) = -4 log w + log f - log g, where
    f = det(v own + theirs) and g = det(w v own + w theirs + v prior). It is 0 at w = 1, and convex: the information
    w P^-1 + H^T N^-1 H is concave in w, N^-1 being a parallel sum, and so is log det.
    """
    o, t, p = (_mixed(A, A) / 2.0 for A in (own, theirs, prior))
    ot, op, tp = _mixed(own, theirs), _mixed(own, prior), _mixed(theirs, prior)

    def f_and_g(w: float) -> tuple[float, float]:
        v = 1.0 - w
        return (v * o + ot) * v + t, w * w * ((v * o + ot) * v + t) + v * (w * (v * op + tp) + v * p)

    def slope(w: float) -> float:
        v = 1.0 - w
        f, g = f_and_g(w)
        by_f = -2.0 * v * o - ot
        by_g = 2.0 * w * f + w * w * by_f + (v - w) * (v * op + tp) - w * v * op - 2.0 * v * p
        return -4.0 / w + by_f / f - by_g / g

    if slope(HIGHEST) <= 0.0:
        w = HIGHEST
    else:
        w = LOWEST if slope(LOWEST) >= 0.0 else brentq(slope, LOWEST, HIGHEST, xtol=1e-9, rtol=1e-9)
    f, g = f_and_g(w)
    return w if -4.0 * log(w) + log(f / g) < 0.0 else 1.0


def _mixed(A: Array, B: Array) -> float:
    """Return the factor m of det(x A + y B) = x^2 det A + x y m + y^2 det B, for symmetric (2, 2)."""
    a, b, _, d = A.ravel().tolist()
    e, g, _, h = B.ravel().tolist()
    return a * h + d * e - 2.0 * b * g
