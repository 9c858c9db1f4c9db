"""The vehicle's pose from one frame alone, whatever was believed of it before."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from coopenv.estimation.arrays import solve
from coopenv.observers.robust.constants import GAUSS_NEWTON_STEPS, MAX_CONDITION
from tests.oracles.robust.belief import Belief
from tests.oracles.robust.matrices import condition
from tests.oracles.robust.sight import View


def resect(belief: Belief, look: Callable[[], View]) -> bool:
    """Put the vehicle where a frame's bearings see it, by least squares from where it is; return whether that works.

    The other members stay. The vehicle's covariance becomes that of the solution, which inherits the members' errors,
    G (N + H_o P_o H_o^T) G^T with G = (H^T W H)^-1 H^T W, and so do its covariances with them, -G H_o P_o.

    Args:
        belief: of the vehicle and the members that it sees.
        look: returns the frame's bearings at the pose that is believed now.
    """
    others = belief.P[6:, 6:]
    for step in range(GAUSS_NEWTON_STEPS):
        view = look()
        sight, noise, fits = view.sight, view.noise, view.fits
        if fits.sum() < 3:
            return False
        H, N = sight.H[fits], noise[fits]
        # the weights count the others' errors bearing by bearing
        own, rest = H[:, :, :6], H[:, :, 6:]
        W = np.linalg.inv(N[:, None, None] * np.eye(2) + rest @ others @ rest.transpose(0, 2, 1))
        weighted = own.transpose(0, 2, 1) @ W
        M = (weighted @ own).sum(axis=0)
        if not condition(M) < MAX_CONDITION:
            return False
        G = solve(M, np.concatenate(weighted, axis=1))
        if step < GAUSS_NEWTON_STEPS - 1:
            belief.shift(G.dot(sight.residual[fits].ravel()))
    rest = rest.reshape(2 * len(rest), len(others))
    belief.P[:6, :6] = G @ (np.diag(np.repeat(N, 2)) + rest @ others @ rest.T) @ G.T
    belief.P[:6, 6:] = -G @ rest @ others
    belief.P[6:, :6] = belief.P[:6, 6:].T
    return True
