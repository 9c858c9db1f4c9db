"""Protection levels: bounds of the own errors that hold with any single faulty source, at the risk `RISK`.

Without source q the solution is x + Phi f with the covariance P + Phi V^-1 Phi^T, see source_monitor.py. The mixture of
likely faults adds to P. If q is the faulty source, the error is at most |Phi f| and the quantile of that covariance.
The level is the largest over all sources that are used, or infinite where the covariance without one of them is too
large to linearise.
Source: Blanch et al., Baseline advanced RAIM user algorithm and possible improvements, IEEE Transactions on Aerospace
and Electronic Systems 51(1), 2015.
"""

from statistics import NormalDist
from typing import Any

import warp as wp

from coopenv.observers.robust import constants
from coopenv.observers.robust.algebra import KNOWN_ANGLE_VARIANCE, KNOWN_POSITION_VARIANCE
from coopenv.observers.robust.memory import SOURCES, vec2d, vec3d, vec6d
from coopenv.observers.robust.sources import CAMERA, is_active
from coopenv.world.warp_internals import subroutine

QUANTILE = NormalDist().inv_cdf(1.0 - 0.5 * constants.RISK)  # of an error along its most uncertain axis


@wp.func
def own_variances(up: Any, P: Any):
    """Return (2,) sums of horizontal, m^2, and angular variances, rad^2, of a left error of covariance P, 6x6.

    `up` (3,) is the vertical in the body frame.
    """
    variances = vec2d(P[3, 3] + P[4, 4] + P[5, 5], P[0, 0] + P[1, 1] + P[2, 2])
    for i in range(3):
        for j in range(3):
            variances[0] -= up[i] * P[3 + i, 3 + j] * up[j]
    return variances


@wp.func
def fault_variances(up: Any, Phi: Any, C: Any):
    """Return likewise those of Phi f: Phi 6x3, and C 3x3 the covariance of the fault f."""
    vertical = vec3d()
    variances = vec2d()
    for i in range(3):
        variances[0] += wp.dot(Phi[i + 3], C * Phi[i + 3])
        variances[1] += wp.dot(Phi[i], C * Phi[i])
        vertical += up[i] * Phi[i + 3]
    variances[0] -= wp.dot(vertical, C * vertical)
    return variances


@wp.func
def levels(up: Any, variances: Any, mean: Any):
    """Return (2,) bounds of horizontal, m, and angular errors, rad: a left error of mean (6,) and variances (2,).

    The sum of variances bounds the variance along any axis.
    """
    shift = vec3d(mean[3], mean[4], mean[5])
    along = wp.dot(up, shift)
    quantile = wp.float64(QUANTILE)
    return vec2d(
        wp.sqrt(wp.max(wp.length_sq(shift) - along * along, wp.float64(0.0)))
        + quantile * wp.sqrt(wp.max(variances[0], wp.float64(0.0))),
        wp.length(vec3d(mean[0], mean[1], mean[2])) + quantile * wp.sqrt(wp.max(variances[1], wp.float64(0.0))),
    )


@subroutine
def protection_level(memory: Any, world: int, i: int):
    """Return (2,) the horizontal, m, and the angular, rad, protection level; infinite: unknown."""
    up = wp.transpose(memory.member[world, i, 0].pose.R) * vec3d(wp.float64(0.0), wp.float64(0.0), wp.float64(1.0))
    own = own_variances(up, memory.P[world, i, 0, 0] + memory.fault_mixture[world, i])
    most = levels(up, own, vec6d())
    for q in range(SOURCES):
        if is_active(memory, world, i, q):
            Phi = memory.sensitivity[world, i, q, 0]
            information = wp.trace(memory.source[world, i, q].information)
            # Before its first block, or since an exclusion; gyro and camera have the covariance of a prior then.
            if q < CAMERA and information == wp.float64(0.0) and wp.ddot(Phi, Phi) > wp.float64(0.0):
                return vec2d(wp.float64(wp.inf))
            variances = own + fault_variances(up, Phi, memory.source[world, i, q].covariance)
            if not (
                variances[0] < wp.float64(KNOWN_POSITION_VARIANCE) and variances[1] < wp.float64(KNOWN_ANGLE_VARIANCE)
            ):
                return vec2d(wp.float64(wp.inf))
            most = wp.max(most, levels(up, variances, Phi * memory.source[world, i, q].offset))
    return most
