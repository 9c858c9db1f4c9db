"""Rotations and rigid motions in NumPy, for single small arrays: `A.dot(B)` takes a third of the time of `A @ B` there.

Rigid motions T = (R, p) of SE(3) have tangent vectors xi = (theta, rho) in rad and m. Source: Barfoot, State Estimation
for Robotics, 2017, chapter 7 (there translations come first).
"""

import math

import numpy as np
from scipy.spatial.transform import Rotation

from coopenv.estimation.arrays import Array

IDENTITY = np.eye(3)
GENERATORS = np.array([[0, 0, 0, 0, 0, -1, 0, 1, 0], [0, 0, 1, 0, 0, 0, -1, 0, 0], [0, -1, 0, 1, 0, 0, 0, 0, 0]], float)
"""(3, 9) S(e) of the three axes e, one a row."""
ONES = np.ones(3)


def skew(v: Array) -> Array:
    """Return S(v) (..., 3, 3) with S(v) y = v x y."""
    v = np.asarray(v, dtype=np.float64)
    result: Array = v.dot(GENERATORS).reshape(*v.shape, 3)
    return result


def lengths(v: Array) -> Array:
    """Return the lengths (m,) of vectors (m, 3)."""
    result: Array = np.sqrt((v * v).dot(ONES))
    return result


def exp_so3(w: Array) -> Array:
    """Return Exp(w), the rotation by |w| rad about w (3,)."""
    x, y, z = float(w[0]), float(w[1]), float(w[2])  # numbers: a small array costs more than all of this
    xx, yy, zz = x * x, y * y, z * z
    square = xx + yy + zz
    if square > 1e-8:
        angle = math.sqrt(square)
        a, b = math.sin(angle) / angle, 2.0 * (math.sin(angle / 2) / angle) ** 2
    else:
        a, b = 1.0 - square / 6.0, 0.5 - square / 24.0
    bxy, bxz, byz, ax, ay, az = b * x * y, b * x * z, b * y * z, a * x, a * y, a * z
    return np.array(
        [
            [1.0 - b * (yy + zz), bxy - az, bxz + ay],
            [bxy + az, 1.0 - b * (xx + zz), byz - ax],
            [bxz - ay, byz + ax, 1.0 - b * (xx + yy)],
        ]
    )


def right_jacobian(w: Array) -> Array:
    """Return J (3, 3) with Exp(w + d) = Exp(w) Exp(J d) to first order in d."""
    x, y, z = float(w[0]), float(w[1]), float(w[2])
    square = x * x + y * y + z * z
    if square > 1e-6:
        angle = math.sqrt(square)
        b, c = 2.0 * (math.sin(angle / 2.0) / angle) ** 2, (1.0 - math.sin(angle) / angle) / square
    else:
        b, c = 0.5 - square / 24.0, 1.0 / 6.0 - square / 120.0
    cxy, cxz, cyz, bx, by, bz = c * x * y, c * x * z, c * y * z, b * x, b * y, b * z
    diagonal = 1.0 - c * square
    return np.array(
        [
            [diagonal + c * x * x, cxy + bz, cxz - by],
            [cxy - bz, diagonal + c * y * y, cyz + bx],
            [cxz + by, cyz - bx, diagonal + c * z * z],
        ]
    )


def log_so3(R: Array) -> Array:
    """Return (3,) the rotation vector of R, of length 0..pi rad."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = R.tolist()
    x, y, z = 0.5 * (zy - yz), 0.5 * (xz - zx), 0.5 * (yx - xy)
    sine, cosine = math.sqrt(x * x + y * y + z * z), 0.5 * (xx + yy + zz - 1.0)
    if cosine <= -0.9:  # near half a turn the vector part has no direction to speak of
        return np.asarray(Rotation.from_matrix(np.array(R)).as_rotvec())  # SciPy 1.14 takes none that is read-only
    scale = math.atan2(sine, cosine) / sine if sine > 1e-9 else 1.0
    return np.array([scale * x, scale * y, scale * z])


def orthonormalise(R: Array) -> Array:
    """Return the rotation nearest to an almost orthogonal R, by one Newton step of the polar factor."""
    result: Array = 1.5 * R - (0.5 * R).dot(R.T.dot(R))
    return result


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


def rigid_exp(w: Array, v: Array) -> tuple[Array, Array]:
    """Return the rotation (3, 3) and translation (3,) of Exp((w, v)), as `exp_se3` does of one pair, but faster."""
    return exp_so3(w), exp_translation(w, v)


def exp_translation(w: Array, v: Array) -> Array:
    """Return the translation (3,) of Exp((w, v)).

    Source: the closed form J v = a v + b w x v + c (w . v) w of the left Jacobian J of SO(3).
    """
    wx, wy, wz = float(w[0]), float(w[1]), float(w[2])
    vx, vy, vz = float(v[0]), float(v[1]), float(v[2])
    square = wx * wx + wy * wy + wz * wz
    if square > 1e-8:
        angle = math.sqrt(square)
        a = math.sin(angle) / angle
        b, c = 2.0 * (math.sin(angle / 2.0) / angle) ** 2, (1.0 - a) / square
    else:
        a, b, c = 1.0 - square / 6.0, 0.5 - square / 24.0, 1.0 / 6.0 - square / 120.0
    along = c * (wx * vx + wy * vy + wz * vz)
    x = a * vx + b * (wy * vz - wz * vy) + along * wx
    y = a * vy + b * (wz * vx - wx * vz) + along * wy
    z = a * vz + b * (wx * vy - wy * vx) + along * wz
    return np.array([x, y, z])


def adjoint(R: Array, p: Array) -> Array:
    """Return Ad (6, 6) of T = (R, p): T Exp(xi) T^-1 = Exp(Ad xi)."""
    A = np.zeros((6, 6))
    A[:3, :3] = A[3:, 3:] = R
    A[3:, :3] = skew(p).dot(R)
    return A
