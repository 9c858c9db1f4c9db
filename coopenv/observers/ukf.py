"""Unscented Kalman filter on SE(3), with the neighbours' covariance as measurement noise.

Source: Brossard, Barrau and Bonnabel, A code for unscented Kalman filtering on manifolds (UKF-M), ICRA 2020, with the
left retraction T = That Exp(xi). In it odometry moves sigma points linearly (see left_invariant.py), so that the
unscented prediction has the closed form that is used; the update takes 13 sigma points through the bearings, which are
compared in the tangent planes at the mean's.
"""

import math
from typing import ClassVar

import numpy as np

from coopenv.estimation.arrays import Array, cholesky, solve
from coopenv.estimation.compiled import MATRICES, MATRIX, VECTOR, compiled
from coopenv.estimation.compiled_matrices import transformed
from coopenv.estimation.compiled_rotations import exp_so3, exp_translation
from coopenv.observers.contract import Tick
from coopenv.observers.left_invariant import InvariantError
from coopenv.observers.lines import Sight, across, ahead, dense, linearised
from coopenv.observers.mekf import LeftError, Mekf
from coopenv.observers.pose_update import FRAME, Frame, frame_of

SPREAD = 6.0  # squared distance of the sigma points from the mean in standard deviations: alpha = 1 in six dimensions
WEIGHT = 1.0 / (2.0 * SPREAD)  # weight of every sigma point but the mean
MEAN_WEIGHT = 2.0  # weight of the mean in covariances: 3 - alpha^2. In means it is 0


class Ukf(Mekf):
    """Unscented (sigma-point) filter; sends covariances."""

    belief: ClassVar[type[LeftError]] = InvariantError
    sends_covariance = True

    def take(self, tick: Tick, sight: Sight) -> None:
        """Correct by what passes the gate."""
        P, frame = self.state.P, frame_of(tick, sight)
        xi = sigma_points(P)
        lines = linearised(self.state, tick, sight)
        mean, S, y = unscented(self.state.R, self.state.p, xi, lines.N, frame)
        r = lines.residual.ravel() - mean
        if self.gated:
            each = np.arange(len(sight.targets))
            blocks = S.reshape(len(each), 2, len(each), 2)[each, :, each, :]
            kept = self.gate.passed(tick.time, r.reshape(-1, 2), blocks, ahead(self.state, tick, sight)).repeat(2)
            if not kept.any():
                return
            if not kept.all():
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


@compiled(VECTOR)
def unit(v: Array) -> Array:
    """Return v (3,) at length 1."""
    return v / max(math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]), 1e-9)


@compiled(MATRIX, VECTOR, MATRIX, MATRICES, FRAME)
def unscented(R: Array, p: Array, xi: Array, N: Array, frame: Frame) -> tuple[Array, Array, Array]:
    """Return the mean (2m,) and covariance (2m, 2m) of bearings in the tangent planes at the mean's, noise N included.

    The third is what each of the sigma points xi (k, 6) adds, (k, 2m).
    """
    lever_arm, _, positions, _, _ = frame
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
