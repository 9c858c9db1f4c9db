"""The joint test of a frame's measurements, which refuses the ones without which the others fit together.

Each measurement may fit a prediction alone, and contradict the others: the gate of one measurement (correction.py)
counts the uncertainty of the prediction for each of them anew. The normalised squared innovation of a whole frame,
r^T S^-1 r, has a chi-square distribution with as many degrees of freedom as rows. If it is too large, the measurement
whose removal reduces it most is refused, until the others fit together.

With W = S^-1 and w = W r, the removal of the rows a reduces the sum by w_a^T W_aa^-1 w_a.
Source: Parkinson and Axelrad, Autonomous GPS integrity monitoring using the pseudorange residual, Navigation 35(2),
1988, for the exclusion by the residuals of subsets.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from coopenv.estimation.poses import Array
from coopenv.observers.correction import RISK, SECOND_ORDER, Constants, joint_jacobian
from coopenv.observers.frame import Frame
from coopenv.observers.linearisation import linearise, stacked


@lru_cache
def largest_of(rows: int) -> float:
    """Return the normalised squared innovation of so many rows that correct measurements exceed with `RISK`."""
    return float(chdtri(rows, RISK))


def innovation(
    R: Array, p: Array, joint: Array, frame: Frame, constants: Constants, places: NDArray[np.int64]
) -> tuple[Array, Array, NDArray[np.int64]]:
    """Return residuals (k,), their covariance S (k, k) and the measurement (k,) of each row, at a prediction.

    S includes the second-order error of angles: with a prediction that is uncertain by ten degrees, bearings contradict
    each other by more than their noise. Arguments are those of `schmidt_kalman.considered`.
    """
    residual, H, N, by_target, _, used, angle, _ = linearise(R, p, False, frame)
    neighbours = (len(joint) - 6 - len(constants[1])) // 6
    whole = joint_jacobian(residual, H, by_target, used, frame, np.eye(6), constants, places, neighbours)
    rows, H, N = stacked(residual, whole, N, by_target, used, frame)
    S, owner, of_angle = H.dot(joint).dot(H.T) + N, used.nonzero()[0], angle[used]
    variance = np.bincount(owner, S.diagonal() * of_angle, len(used))[owner]
    return rows, S + np.diag(SECOND_ORDER * of_angle * variance**2), owner


def fitting_together(residual: Array, S: Array, owner: NDArray[np.int64], measurements: int) -> NDArray[np.bool_]:
    """Return which of the measurements (m,) fit together; arguments are the results of `innovation`, and m."""
    kept = np.ones(measurements, bool)
    while kept.sum() > 1:
        rows = kept[owner]
        W, of, left = np.linalg.inv(S[np.ix_(rows, rows)]), owner[rows], kept.nonzero()[0]
        w = W.dot(residual[rows])
        if residual[rows].dot(w) <= largest_of(len(w)):
            break
        parts = [np.flatnonzero(of == n) for n in left]
        reductions = [w[a].dot(np.linalg.solve(W[np.ix_(a, a)], w[a])) for a in parts]
        kept[left[int(np.argmax(reductions))]] = False
    return kept
