"""The group SE(3) of rigid motions T = (R, p), with tangent vectors xi = (theta, rho) in rad and m.

Source: Barfoot, State Estimation for Robotics, 2017, chapter 7 (there translations come first).
"""

from __future__ import annotations

import numpy as np

from coopenv.estimation.observers.base import Array
from coopenv.estimation.observers.rotations import IDENTITY, skew


def exp_se3(xi: Array) -> tuple[Array, Array]:
    """Return the rotations (..., 3, 3) and translations (..., 3) of Exp(xi) for xi (..., 6)."""
    theta, rho = xi[..., :3], xi[..., 3:]
    square = (theta * theta).sum(-1)
    small = square < 1e-4  # there the quotients lose digits, and the series have an error below 1e-15
    s = np.where(small, 1.0, square)
    angle = np.sqrt(s)
    sine = np.sin(angle)
    a = np.where(small, 1.0 - square / 6.0 + square**2 / 120.0, sine / angle)
    b = np.where(small, 0.5 - square / 24.0 + square**2 / 720.0, 2.0 * np.sin(angle / 2.0) ** 2 / s)
    c = np.where(small, 1.0 / 6.0 - square / 120.0 + square**2 / 5040.0, (angle - sine) / (s * angle))
    S = skew(theta)
    SS = S @ S
    a, b, c = a[..., None, None], b[..., None, None], c[..., None, None]
    left_jacobian = IDENTITY + b * S + c * SS
    return IDENTITY + a * S + b * SS, (left_jacobian @ rho[..., None])[..., 0]


def adjoint(R: Array, p: Array) -> Array:
    """Return Ad (6, 6) of T = (R, p): T Exp(xi) T^-1 = Exp(Ad xi)."""
    A = np.zeros((6, 6))
    A[:3, :3] = A[3:, 3:] = R
    A[3:, :3] = skew(p) @ R
    return A
