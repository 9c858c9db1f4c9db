"""Covariances of estimated poses in the map's axes, as ROS and viewers have them."""

import numpy as np

from coopenv.estimation.arrays import Array
from coopenv.estimation.coordinates import Coordinates
from coopenv.estimation.rotations import skew


def covariance_in_map(coordinates: Coordinates, rotation: Array, position: Array, covariance: Array) -> Array:
    """Return covariances (..., 6, 6) of (position, rotation about the map's fixed axes), m and rad, to first order.

    The errors are d and phi with p = phat + d and R = Exp(phi) Rhat, as in `geometry_msgs/PoseWithCovariance`.

    Args:
        coordinates: of the error that `covariance` is about.
        rotation: Rhat (..., 3, 3), body to map.
        position: phat (..., 3), map, m.
        covariance: P (..., 6, 6).
    """
    R, p = np.asarray(rotation, float), np.asarray(position, float)
    J = np.zeros((*p.shape[:-1], 6, 6))
    if coordinates is Coordinates.RIGHT:  # d = theta x phat + rho, phi = theta
        J[..., :3, :3], J[..., :3, 3:], J[..., 3:, :3] = -skew(p), np.eye(3), np.eye(3)
    else:  # d = Rhat rho, phi = Rhat theta; in the paper's coordinates rho = e - (Rhat^T phat) x theta
        J[..., :3, 3:], J[..., 3:, :3] = R, R
        if coordinates is Coordinates.RICCATI:
            body = (np.swapaxes(R, -1, -2) @ p[..., None])[..., 0]
            J[..., :3, :3] = -R @ skew(body)
    return np.asarray(J @ np.asarray(covariance, float) @ np.swapaxes(J, -1, -2))


def position_covariance(rotation: Array, position: Array, covariance: Array) -> Array:
    """Return covariances (..., 3, 3) of estimated positions in the map frame, m^2, to first order.

    Args:
        rotation: Rhat (..., 3, 3), body to map.
        position: phat (..., 3), body frame, m.
        covariance: P (..., 6, 6) in the paper's coordinates, over (2 lambda, p - phat).
    """
    R, p = np.asarray(rotation, float), np.asarray(position, float)
    in_map = (R @ p[..., None])[..., 0]
    return covariance_in_map(Coordinates.RICCATI, R, in_map, covariance)[..., :3, :3]
