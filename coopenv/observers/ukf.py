"""Unscented Kalman filter on SE(3), with the neighbours' covariance as measurement noise.

Source: Brossard, Barrau and Bonnabel, A code for unscented Kalman filtering on manifolds (UKF-M), ICRA 2020, with the
left retraction T = That Exp(xi). In it odometry moves sigma points linearly (see left_invariant.py), so that the
unscented prediction has the closed form that is used; the update takes 13 sigma points through the bearings, which are
compared in the tangent planes at the mean's.
"""

from typing import ClassVar

import numpy as np

from coopenv.estimation.arrays import Array, cholesky, solve
from coopenv.estimation.rotations import exp_se3, lengths
from coopenv.observers.contract import Tick
from coopenv.observers.left_invariant import InvariantError
from coopenv.observers.lines import Sight, ahead, dense, innovation, noise
from coopenv.observers.mekf import LeftError, Mekf

SPREAD = 6.0  # squared distance of the sigma points from the mean in standard deviations: alpha = 1 in six dimensions
WEIGHT = 1.0 / (2.0 * SPREAD)  # weight of every sigma point but the mean
MEAN_WEIGHT = 2.0  # weight of the mean in covariances: 3 - alpha^2. In means it is 0


class Ukf(Mekf):
    """Unscented (sigma-point) filter; sends covariances."""

    belief: ClassVar[type[LeftError]] = InvariantError
    sends_covariance = True

    def take(self, tick: Tick, sight: Sight) -> None:
        """Correct by what passes the gate."""
        R, p, P = self.state.R, self.state.p, self.state.P
        residual, J = innovation(R, p, tick.lever_arm, sight.bearings, sight.positions)
        distance = 1.0 / lengths(J[:, 0])
        basis = J * distance[:, None, None]
        xi = sigma_points(P)  # (12, 6)
        turn, shift = exp_se3(xi)
        d = ((sight.positions - p).dot(R) - shift[:, None]) @ turn - tick.lever_arm  # (12, m, 3)
        bearings = d / np.maximum(np.sqrt((d * d).sum(-1, keepdims=True)), 1e-9)
        y = (basis @ bearings[..., None])[..., 0].reshape(len(xi), -1)  # (12, 2m), 0 for the mean
        mean = WEIGHT * y.sum(0)
        y -= mean
        S = WEIGHT * y.T.dot(y) + MEAN_WEIGHT * np.outer(mean, mean) + dense(noise(R, J, tick, sight))
        r = residual.ravel() - mean
        if self.gated:
            each = np.arange(len(residual))
            blocks = S.reshape(len(each), 2, len(each), 2)[each, :, each, :]
            kept = self.gate.passed(tick.time, r.reshape(-1, 2), blocks, ahead(self.state, tick, sight)).repeat(2)
            if not kept.any():
                return
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
