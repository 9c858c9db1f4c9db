"""The group SE(3) of rigid motions T = (R, p), with tangent vectors xi = (theta, rho) in rad and m.

Source: Barfoot, State Estimation for Robotics, 2017, chapter 7 (there translations come first).
"""

import numpy as np

from coopenv.estimation.arrays import Array
from coopenv.estimation.rotations import IDENTITY, skew


def exp_se3(xi: Array) -> tuple[Array, Array]:
    """Return the rotations (..., 3, 3) and translations (..., 3) of Exp(xi) for xi (..., 6)."""
    theta, rho = xi[..., :3], xi[..., 3:]
    square = np.maximum((theta * theta).sum(-1)[..., None, None], 1e-30)
    angle = np.sqrt(square)
    a, b = np.sin(angle) / angle, 2.0 * (np.sin(angle / 2.0) / angle) ** 2
    c = (1.0 - a) / square  # digits that it loses at small angles do not count beside the identity
    S = skew(theta)
    SS = S @ S
    left_jacobian = IDENTITY + b * S + c * SS
    return IDENTITY + a * S + b * SS, (left_jacobian @ rho[..., None])[..., 0]


def adjoint(R: Array, p: Array) -> Array:
    """Return Ad (6, 6) of T = (R, p): T Exp(xi) T^-1 = Exp(Ad xi)."""
    A = np.zeros((6, 6))
    A[:3, :3] = A[3:, 3:] = R
    A[3:, :3] = skew(p).dot(R)
    return A
