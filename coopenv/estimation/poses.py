"""Rotations, rigid motions, pose errors and their covariances in NumPy.

For single small arrays `A.dot(B)` takes a third of the time of `A @ B`, and LAPACK a part of that of `numpy.linalg`.
Rigid motions T = (R, p) of SE(3) have tangent vectors xi = (theta, rho) in rad and m. Source: Barfoot, State Estimation
for Robotics, 2017, chapter 7 (there translations come first).
"""

import math
from enum import Enum
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dgesv, dpotrf
from scipy.spatial.transform import Rotation

from coopenv.base.errors import CoopenvError, explained

Array = NDArray[np.float64]


def solve(A: Array, b: Array) -> Array:
    """Return A^-1 b; a LinAlgError means that A is singular."""
    _, _, x, failed = dgesv(A, b)
    if failed:
        raise np.linalg.LinAlgError("singular matrix")
    return np.asarray(x)


def cholesky(A: Array) -> Array:
    """Return the lower triangular L of A = L L^T; a LinAlgError means that A is not positive definite."""
    factor, failed = dpotrf(A, lower=True)
    if failed:
        raise np.linalg.LinAlgError("not positive definite")
    return np.asarray(factor)


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


def about_z(angle: Array) -> Array:
    """Return the rotations (..., 3, 3) about z by angles (...) rad; NaN where an angle is."""
    c, s, zero = np.cos(angle), np.sin(angle), 0.0 * angle
    rows = [np.stack(row, axis=-1) for row in ((c, -s, zero), (s, c, zero), (zero, zero, zero + 1.0))]
    return np.stack(rows, axis=-2)


MISFIT_DEG = 30.0
"""Median angle between bearings and true poses above which these have another unit or frame."""


def bearing_misfit_deg(rotation: Array, position: Array, bearings: Array, targets: Array) -> float:
    """Return the median angle between measured bearings and those by true poses, deg; NaN without any.

    Args:
        rotation: (M, 3, 3) body to map.
        position: (M, 3) m, map.
        bearings: (M, 3) unit vectors in the body frame.
        targets: (M, 3) m, map.
    """
    away = targets - position
    along = np.einsum("mij,mi,mj->m", rotation, away, bearings) / np.maximum(lengths(away), 1e-9)
    known = along[np.isfinite(along)]
    return float(np.degrees(np.median(np.arccos(np.clip(known, -1.0, 1.0))))) if len(known) else float("nan")


def error_rotation(rotation: np.ndarray, rotation_estimate: np.ndarray) -> np.ndarray:
    """Return Rtilde = Rhat^T R of rotations (..., 3, 3) that map body to map frame."""
    return np.asarray(np.swapaxes(np.asarray(rotation_estimate, float), -1, -2) @ np.asarray(rotation, float))


def quaternion_wxyz(rotation: np.ndarray) -> np.ndarray:
    """Return the unit quaternions (..., 4) of rotations (..., 3, 3), scalar part first and never negative.

    Each row of 4 q q^T, which is linear in R, is a multiple of q; that of the largest component is well conditioned at
    every angle, and at small ones takes the vector part from the skew part of R, without cancellation. SciPy's would
    raise an error over the estimates of an observer that is lost (NaN, or far from a rotation).
    """
    R = np.asarray(rotation, float)
    x, y, z = R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]
    outer = np.empty((*R.shape[:-2], 4, 4))
    outer[..., 0, 0] = 1 + x + y + z
    outer[..., 1, 1] = 1 + x - y - z
    outer[..., 2, 2] = 1 - x + y - z
    outer[..., 3, 3] = 1 - x - y + z
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        outer[..., 0, i + 1] = outer[..., i + 1, 0] = R[..., k, j] - R[..., j, k]
        outer[..., j + 1, k + 1] = outer[..., k + 1, j + 1] = R[..., j, k] + R[..., k, j]
    best = np.argmax(np.diagonal(outer, axis1=-2, axis2=-1), axis=-1)
    q = np.take_along_axis(outer, best[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.asarray(np.where(q[..., :1] < 0, -q, q))


def orientation_error_deg(rotation: np.ndarray, rotation_estimate: np.ndarray) -> np.ndarray:
    """Return the geodesic angle between rotations (..., 3, 3) in degrees, in [0, 180].

    2 atan2(|lambda|, scalar part) keeps its accuracy at both ends, where acos of the trace has none: 1e-12
    deg differs from zero, and a half turn is 180 deg exactly.
    """
    q = quaternion_wxyz(error_rotation(rotation, rotation_estimate))
    return np.asarray(np.degrees(2 * np.arctan2(np.linalg.norm(q[..., 1:], axis=-1), q[..., 0])))


def error_dof(rotation: Array, position: Array, rotation_estimate: Array, position_estimate: Array) -> int:
    """Return the degrees of freedom of the errors of poses (..., 3, 3) and (..., 3): 6, or 3 if none leaves a plane.

    Planar estimates of robots have them, too. Poses that are NaN do not count.
    """
    tilt = np.abs(np.asarray(rotation_estimate)[..., 2, :] - np.asarray(rotation)[..., 2, :]).max(axis=-1)
    height = np.abs(np.asarray(position_estimate)[..., 2] - np.asarray(position)[..., 2])
    return 3 if np.fmax.reduce(np.fmax(tilt, height), axis=None) < 1e-6 else 6


def roll_pitch_yaw_deg(rotation: np.ndarray) -> np.ndarray:
    """Return (..., 3) roll, pitch, yaw in degrees with R = Rz(yaw) Ry(pitch) Rx(roll)."""
    R = np.asarray(rotation, float)
    roll = np.arctan2(R[..., 2, 1], R[..., 2, 2])
    pitch = np.arctan2(-R[..., 2, 0], np.hypot(R[..., 0, 0], R[..., 1, 0]))
    yaw = np.arctan2(R[..., 1, 0], R[..., 0, 0])
    return np.asarray(np.degrees(np.stack([roll, pitch, yaw], axis=-1)))


class Coordinates(Enum):
    """The error e that a covariance is about; truth (R, p), estimate (Rhat, phat), positions in the map frame."""

    LEFT = "left"  # (theta, rho): R = Rhat Exp(theta), p = phat + Rhat rho
    RIGHT = "right"  # (theta, rho): R = Exp(theta) Rhat, p = Exp(theta) phat + rho
    RICCATI = "riccati"
    """(2 lambda, R^T p - Rhat^T phat), the paper's; lambda is the vector part of the quaternion of Rhat^T R."""

    def error(self, rotation: Array, position: Array, rotation_estimate: Array, position_estimate: Array) -> Array:
        """Return e (..., 6) in rad and m, of truth against estimate over any leading axes."""
        R, R_hat = np.asarray(rotation, float), np.asarray(rotation_estimate, float)
        R_hat_T = np.swapaxes(R_hat, -1, -2)
        if self is Coordinates.RICCATI:
            body = np.einsum("...ji,...j->...i", R, position) - np.einsum("...ji,...j->...i", R_hat, position_estimate)
            return np.concatenate([2 * quaternion_wxyz(error_rotation(R, R_hat))[..., 1:], body], axis=-1)
        if self is Coordinates.LEFT:
            tilde = error_rotation(R, R_hat)
            rho = (R_hat_T @ (position - position_estimate)[..., None])[..., 0]
        else:
            tilde = R @ R_hat_T
            rho = position - (tilde @ position_estimate[..., None])[..., 0]
        theta = Rotation.from_matrix(tilde.reshape(-1, 3, 3)).as_rotvec().reshape(rho.shape)
        return np.concatenate([theta, rho], axis=-1)


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


@partial(explained, hint='; of an info: position_covariance(**info["estimate"])')
def position_covariance(rotation: Array, position: Array, covariance: Array) -> Array:
    """Return covariances (..., 3, 3) of estimated positions in the map frame, m^2, to first order.

    Infos and trajectories have an estimate as (Rhat, phat) and P over (2 lambda, R^T p - Rhat^T phat), rad and m:

        position_covariance(**info["estimate"])

    Args:
        rotation: Rhat (..., 3, 3), body to map.
        position: phat (..., 3), map frame, m.
        covariance: P (..., 6, 6) in the paper's coordinates.

    Raises:
        CoopenvError: another shape.
    """
    shapes = [np.shape(values) for values in (rotation, position, covariance)]
    if (shapes[0][-2:], shapes[1][-1:], shapes[2][-2:]) != ((3, 3), (3,), (6, 6)):
        raise CoopenvError(f"position_covariance: expected (..., 3, 3), (..., 3) and (..., 6, 6), got {shapes}")
    return covariance_in_map(Coordinates.RICCATI, rotation, position, covariance)[..., :3, :3]


def riccati_covariance(coordinates: Coordinates, rotation: Array, position: Array, covariance: Array) -> Array:
    """Return a covariance (6, 6) in RICCATI coordinates, to first order.

    With R = Rhat Exp(theta) and p = phat + Rhat rho (LEFT), R^T p = Rhat^T phat + rho + [Rhat^T phat]x theta + ...,
    and 2 lambda = theta + ...; a RIGHT error (theta, rho) turns both by Rhat^T.

    Args:
        coordinates: of the error that `covariance` is about.
        rotation: Rhat (3, 3), body to map.
        position: phat (3,), map, m.
        covariance: P (6, 6).
    """
    if coordinates is Coordinates.RICCATI:
        return covariance
    if coordinates is Coordinates.LEFT:
        return _sheared(skew(rotation.T @ position), covariance)
    J = np.kron(np.eye(2), rotation.T)
    return _symmetric(J @ covariance @ J.T)


def left_covariance(position: Array, covariance: Array) -> Array:
    """Return a covariance over (2 lambda, p) in LEFT coordinates, to first order; `position` is in the body, m."""
    return _sheared(-skew(position), covariance)


def _sheared(S: Array, P: Array) -> Array:
    """Return T P T^T, T = [[I, 0], [S, I]], exactly symmetric."""
    T = np.eye(6)
    T[3:, :3] = S
    return _symmetric(T @ P @ T.T)


def _symmetric(P: Array) -> Array:
    return np.asarray((P + P.T) / 2, dtype=np.float64)
