"""Coordinates of the pose error that a covariance is about."""

from enum import Enum

import numpy as np
from scipy.spatial.transform import Rotation

from coopenv.estimation.arrays import Array
from coopenv.estimation.metrics import error_coordinates, error_rotation


class Coordinates(Enum):
    """The error e that a covariance is about; truth (R, p), estimate (Rhat, phat), positions in the map frame."""

    LEFT = "left"  # (theta, rho): R = Rhat Exp(theta), p = phat + Rhat rho
    RIGHT = "right"  # (theta, rho): R = Exp(theta) Rhat, p = Exp(theta) phat + rho
    RICCATI = "riccati"
    """(2 lambda, R^T p - Rhat^T phat), the paper's; lambda is the vector part of the quaternion of Rhat^T R."""

    def error(self, rotation: Array, position: Array, rotation_estimate: Array, position_estimate: Array) -> Array:
        """Return e (..., 6) in rad and m, of truth against estimate over any leading axes."""
        if self is Coordinates.RICCATI:
            return error_coordinates(position, rotation, position_estimate, rotation_estimate)
        R, R_hat = np.asarray(rotation), np.asarray(rotation_estimate)
        R_hat_T = np.swapaxes(R_hat, -1, -2)
        if self is Coordinates.LEFT:
            tilde = error_rotation(R, R_hat)
            rho = (R_hat_T @ (position - position_estimate)[..., None])[..., 0]
        else:
            tilde = R @ R_hat_T
            rho = position - (tilde @ position_estimate[..., None])[..., 0]
        theta = Rotation.from_matrix(tilde.reshape(-1, 3, 3)).as_rotvec().reshape(rho.shape)
        return np.concatenate([theta, rho], axis=-1)
