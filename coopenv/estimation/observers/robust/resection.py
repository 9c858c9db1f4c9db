"""The vehicle's pose from one frame alone, whatever was believed of it before."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.linalg import block_diag

from coopenv.estimation.observers.base import Array
from coopenv.estimation.observers.robust.belief import Belief, Line

STEPS = 6
LEAST_INFORMATION = 1e-12
"""Of the weakest direction relative to the strongest; below it the frame does not tell the pose."""


def resect(belief: Belief, look: Callable[[], list[tuple[Line, Array]]]) -> bool:
    """Put the vehicle where a frame's bearings see it, by least squares from where it is; return whether that works.

    The other members stay. The vehicle's covariance becomes that of the solution, which inherits the members' errors,
    G (N + H_o P_o H_o^T) G^T with G = (H^T W H)^-1 H^T W, and so do its covariances with them, -G H_o P_o.

    Args:
        belief: of the vehicle and the members that it sees.
        look: returns the frame's bearings, and their own noise, as measurements at the pose that is believed now.
    """
    others = belief.P[6:, 6:]
    for step in range(STEPS):
        lines = look()
        if len(lines) < 3:
            return False
        H = np.concatenate([line.H for line, _ in lines])
        own, rest = H[:, :6], H[:, 6:]
        N = block_diag(*[noise for _, noise in lines])
        # the weights count the others' errors bearing by bearing
        W = block_diag(*[np.linalg.inv(noise + theirs(line, others)) for line, noise in lines])
        M = own.T @ W @ own
        spectrum = np.linalg.eigvalsh(M)
        if not spectrum[0] > LEAST_INFORMATION * spectrum[-1]:
            return False
        G = np.linalg.solve(M, own.T @ W)
        if step < STEPS - 1:
            belief.shift(G @ np.concatenate([line.residual for line, _ in lines]))
    belief.P[:6, :6] = G @ (N + rest @ others @ rest.T) @ G.T
    belief.P[:6, 6:] = -G @ rest @ others
    belief.P[6:, :6] = belief.P[:6, 6:].T
    return True


def theirs(line: Line, others: Array) -> Array:
    """Return the covariance (2, 2) that the members' errors give a bearing."""
    rest = line.H[:, 6:]
    return rest @ others @ rest.T
