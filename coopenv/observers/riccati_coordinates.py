"""An estimate as the state of a world holds it: body-frame position, covariance over (2 lambda, p)."""

import numpy as np

from coopenv.estimation.arrays import Array
from coopenv.estimation.coordinates import Coordinates
from coopenv.estimation.rotations import skew
from coopenv.observers.contract import Estimate


def riccati_jacobian(estimate: Estimate) -> Array:
    """Return J (6, 6) with e_riccati = J e to first order, e being the error in the estimate's own coordinates.

    With R = Rhat Exp(theta) and p = phat + Rhat rho (LEFT), R^T p = Rhat^T phat + rho + [Rhat^T phat]x theta + ...,
    and 2 lambda = theta + ...; a RIGHT error (theta, rho) turns both by Rhat^T.
    """
    J, R_T = np.eye(6), estimate.rotation.T
    if estimate.coordinates is Coordinates.LEFT:
        J[3:, :3] = skew(R_T @ estimate.position)
    elif estimate.coordinates is Coordinates.RIGHT:
        J[:3, :3] = J[3:, 3:] = R_T
    return J


def left_covariance(position: Array, covariance: Array) -> Array:
    """Return a covariance over (2 lambda, p) in LEFT coordinates, to first order; `position` is in the body, m."""
    J = np.eye(6)
    J[3:, :3] = -skew(position)
    P = J @ covariance @ J.T
    return np.asarray((P + P.T) / 2, dtype=np.float64)


def riccati_covariance(estimate: Estimate) -> Array | None:
    """Return the stated covariance in RICCATI coordinates to first order; None where none is stated."""
    if estimate.covariance is None or estimate.coordinates is Coordinates.RICCATI:
        return estimate.covariance
    J = riccati_jacobian(estimate)
    P = J @ estimate.covariance @ J.T
    return (P + P.T) / 2
