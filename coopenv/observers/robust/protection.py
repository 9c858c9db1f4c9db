"""Protection levels: bounds of the own errors that hold with any single faulty source, at the risk RISK.

Without source q the solution is x + Phi f with the covariance P + Phi V^-1 Phi^T, see source_monitor.py. If q is the
faulty one, the error is at most |Phi f| and the quantile of that covariance. The level is the largest over all sources
that are used, or infinite where the covariance without one of them is too large to linearise.
Source: Blanch et al., Baseline advanced RAIM user algorithm and possible improvements, IEEE Transactions on Aerospace
and Electronic Systems 51(1), 2015.
"""

from statistics import NormalDist
from typing import Any

import warp as wp

from coopenv.observers.robust import constants
from coopenv.observers.robust.algebra import is_known
from coopenv.observers.robust.memory import SOURCES, vec2d, vec3d, vec6d
from coopenv.observers.robust.sources import is_active
from coopenv.world.warp_internals import device_function

QUANTILE = NormalDist().inv_cdf(1.0 - 0.5 * constants.RISK)  # of an error along its most uncertain axis


@wp.func
def levels(R: Any, P: Any, mean: Any):
    """Return (2,) bounds of the horizontal error, m, and of the angle, rad, of a left error of a mean and covariance.

    The trace bounds the variance along any axis.
    """
    up = vec3d(R[2, 0], R[2, 1], R[2, 2])
    shift = vec3d(mean[3], mean[4], mean[5])
    along = wp.dot(up, shift)
    angle = P[0, 0] + P[1, 1] + P[2, 2]
    horizontal = P[3, 3] + P[4, 4] + P[5, 5]
    for i in range(3):
        for j in range(3):
            horizontal -= up[i] * P[3 + i, 3 + j] * up[j]
    quantile = wp.float64(QUANTILE)
    return vec2d(
        wp.sqrt(wp.max(wp.length_sq(shift) - along * along, wp.float64(0.0)))
        + quantile * wp.sqrt(wp.max(horizontal, wp.float64(0.0))),
        wp.length(vec3d(mean[0], mean[1], mean[2])) + quantile * wp.sqrt(wp.max(angle, wp.float64(0.0))),
    )


@device_function
def protection_level(memory: Any, world: int, i: int):
    """Return (2,) the horizontal, m, and the angular, rad, protection level; infinite: unknown."""
    R = memory.member[world, i, 0].pose.R
    own = memory.P[world, i, 0, 0] + memory.doubt[world, i]
    most = levels(R, own, vec6d())
    for q in range(SOURCES):
        if is_active(memory, world, i, q):
            Phi = memory.sensitivity[world, i, q, 0]
            P = own + Phi * memory.source[world, i, q].covariance * wp.transpose(Phi)
            if not is_known(P):
                return vec2d(wp.float64(wp.inf))
            most = wp.max(most, levels(R, P, Phi * memory.source[world, i, q].offset))
    return most
