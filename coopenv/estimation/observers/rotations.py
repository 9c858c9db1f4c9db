"""Rotations in NumPy, written for single small arrays."""

from __future__ import annotations

import math

import numpy as np

from coopenv.estimation.observers.base import Array


def skew(v: Array) -> Array:
    """Return S(v) (..., 3, 3) with S(v) y = v x y."""
    v = np.asarray(v, dtype=np.float64)
    S = np.zeros((*v.shape, 3))
    S[..., 0, 1], S[..., 0, 2], S[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    S[..., 1, 0], S[..., 2, 0], S[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return S


def exp_so3(w: Array) -> Array:
    """Return Exp(w), the rotation by |w| rad about w (3,)."""
    square = float(w @ w)
    if square > 1e-8:
        angle = math.sqrt(square)
        a, b = math.sin(angle) / angle, 2.0 * (math.sin(angle / 2) / angle) ** 2
    else:
        a, b = 1.0 - square / 6.0, 0.5 - square / 24.0
    S = skew(w)
    return np.eye(3) + a * S + b * (S @ S)


def orthonormalise(R: Array) -> Array:
    """Return the rotation nearest to an almost orthogonal R, by one Newton step of the polar factor."""
    return 1.5 * R - 0.5 * R @ (R.T @ R)


def tangent_basis(b: Array) -> Array:
    """Return (m, 2, 3) orthonormal rows across each unit vector b (m, 3)."""
    helper = np.where(np.abs(b[:, :1]) > 0.7, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]])
    S = skew(b)
    first = (S @ helper[..., None])[..., 0]
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, (S @ first[..., None])[..., 0]], axis=1)
