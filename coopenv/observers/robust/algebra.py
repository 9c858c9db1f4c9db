"""Poses, their errors and their propagation by odometry; 6x6 systems and matrices of such blocks; all in float64."""

from typing import Any

import warp as wp

from coopenv.estimation.linalg import (
    THIRD,
    block3,
    cholesky6,
    exp_so3,
    join6,
    orthonormalise,
    quaternion_vector,
    rodrigues,
    rotation_vector_sine,
    skew,
    symmetric_part,
    turn_by,
)
from coopenv.observers.robust import constants
from coopenv.world.warp_internals import device_function

vec2d: Any = wp.vec2d
vec3d: Any = wp.vec3d
vec4d: Any = wp.vec4d
mat22d: Any = wp.mat22d
mat33d: Any = wp.mat33d
vec6d: Any = wp.types.vector(6, wp.float64)
mat26d: Any = wp.types.matrix((2, 6), wp.float64)
mat66d: Any = wp.types.matrix((6, 6), wp.float64)
mat63d: Any = wp.types.matrix((6, 3), wp.float64)
mat23d: Any = wp.types.matrix((2, 3), wp.float64)
mat66f: Any = wp.types.matrix((6, 6), wp.float32)

KNOWN_ANGLE_VARIANCE = constants.KNOWN_ANGLE**2
KNOWN_POSITION_VARIANCE = constants.KNOWN_POSITION**2
VAGUE_ANGLE_VARIANCE = constants.VAGUE_ANGLE**2
QUARTER = 0.25 / constants.MAX_ACCELERATION**2
BEYOND = -0.9  # cosine of an angle below which the skew part of a rotation does not determine its axis


@wp.struct
class Pose:
    """Pose, body to map; or an increment of odometry, from its end to its start."""

    R: mat33d
    p: vec3d


@wp.struct
class PoseEstimate:
    """A pose and its covariance."""

    pose: Pose
    P: mat66d


@wp.func
def log_so3(R: Any):
    """Return the rotation vector of R, of length 0..pi rad."""
    v = rotation_vector_sine(R)
    sine = wp.length(v)
    cosine = wp.float64(0.5) * (wp.trace(R) - wp.float64(1.0))
    if cosine > wp.float64(BEYOND):
        if sine > wp.float64(1.0e-9):
            return v * (wp.atan2(sine, cosine) / sine)
        return v
    vector = quaternion_vector(R)
    length = wp.length(vector)
    return vector * (wp.float64(2.0) * wp.atan2(length, wp.float64(0.5) * sine / length) / length)


@wp.func
def position_variance(P: Any):
    """Return the sum of the variances of a position, m^2, of a covariance, 6x6."""
    return wp.float64(P[3, 3]) + wp.float64(P[4, 4]) + wp.float64(P[5, 5])


@wp.func
def left_error(pose: Pose, other: Pose):
    """Return the left error (theta, rho) of another pose against one."""
    Rt = wp.transpose(pose.R)
    error = vec6d()
    error[:3] = log_so3(Rt * other.R)
    error[3:] = Rt * (other.p - pose.p)
    return error


@wp.func
def displaced(pose: Pose, error: Any):
    """Return the pose that has a left error against one."""
    return Pose(pose.R * exp_so3(error[:3]), pose.p + pose.R * error[3:])


@wp.func
def recentring(error: Any):
    """Return the derivative, 6x6, of errors about a moved pose by errors about the pose before.

    Exp(theta') = Exp(-dtheta) Exp(theta) and rho' = Exp(-dtheta) (rho - drho): diag(J_r(dtheta), Exp(-dtheta)).
    Source: Sola, Deray and Atchuthan, A micro Lie theory for state estimation in robotics, arXiv:1812.01537, (143).
    """
    w = error[:3]
    square = wp.dot(w, w)
    a, b, c = rodrigues(square)
    S = skew(w)
    right = wp.identity(3, wp.float64) - b * S + c * (S * S)
    return join6(right, mat33d(), mat33d(), wp.transpose(turn_by(w, square, a, b)))


@wp.func
def by_rows(H: Any, M: Any):
    """Return H M for a 2x6 matrix H and a 6x6 matrix M, by rows, which compilers vectorise."""
    return wp.matrix_from_rows(
        H[0, 0] * M[0] + H[0, 1] * M[1] + H[0, 2] * M[2] + H[0, 3] * M[3] + H[0, 4] * M[4] + H[0, 5] * M[5],
        H[1, 0] * M[0] + H[1, 1] * M[1] + H[1, 2] * M[2] + H[1, 3] * M[3] + H[1, 4] * M[4] + H[1, 5] * M[5],
    )


@wp.func
def transposed_by_rows(K: Any, H: Any):
    """Return K^T H for two 2x6 matrices, likewise."""
    a = H[0]
    b = H[1]
    return wp.matrix_from_rows(
        K[0, 0] * a + K[1, 0] * b,
        K[0, 1] * a + K[1, 1] * b,
        K[0, 2] * a + K[1, 2] * b,
        K[0, 3] * a + K[1, 3] * b,
        K[0, 4] * a + K[1, 4] * b,
        K[0, 5] * a + K[1, 5] * b,
    )


@wp.func
def diagonal_by_rows(G: Any, M: Any):
    """Return G M for a 6x6 matrix G that is zero but for its blocks of 3x3 on the diagonal, likewise."""
    return wp.matrix_from_rows(
        G[0, 0] * M[0] + G[0, 1] * M[1] + G[0, 2] * M[2],
        G[1, 0] * M[0] + G[1, 1] * M[1] + G[1, 2] * M[2],
        G[2, 0] * M[0] + G[2, 1] * M[1] + G[2, 2] * M[2],
        G[3, 3] * M[3] + G[3, 4] * M[4] + G[3, 5] * M[5],
        G[4, 3] * M[3] + G[4, 4] * M[4] + G[4, 5] * M[5],
        G[5, 3] * M[3] + G[5, 4] * M[4] + G[5, 5] * M[5],
    )


@wp.func
def errors_by_rows(G: Any, M: Any):
    """Return G M for the derivative G of `errors_transition` and a matrix M of six rows, likewise."""
    return wp.matrix_from_rows(
        G[0, 0] * M[0],
        G[1, 1] * M[1],
        G[2, 2] * M[2],
        G[3, 0] * M[0] + G[3, 1] * M[1] + G[3, 2] * M[2] + G[3, 3] * M[3],
        G[4, 0] * M[0] + G[4, 1] * M[1] + G[4, 2] * M[2] + G[4, 3] * M[3],
        G[5, 0] * M[0] + G[5, 1] * M[1] + G[5, 2] * M[2] + G[5, 3] * M[3],
    )


@wp.func
def recentred(G: Any, P: Any):
    """Return G P G^T for a matrix G that is zero but for its blocks of 3x3 on the diagonal, and a symmetric P."""
    return diagonal_by_rows(G, wp.transpose(diagonal_by_rows(G, P)))


@wp.func
def moved(pose: Pose, step: Pose):
    """Return a pose after an increment of odometry."""
    return Pose(orthonormalise(pose.R * step.R), pose.p + pose.R * step.p)


@wp.func
def between(before: Pose, after: Pose):
    """Return the increment from one pose to another."""
    Rt = wp.transpose(before.R)
    return Pose(Rt * after.R, Rt * (after.p - before.p))


@wp.func
def forward(step: Pose, M: Any):
    """Return F M for a matrix M of six rows: by rows, in a fourth of the time of a full product.

    F = [[E, 0], [-E [p]x, E]] with E = R^T is the transition of the left error over an increment (R, p) of odometry.
    """
    R = step.R
    p = step.p
    u = M[3] + p[2] * M[1] - p[1] * M[2]
    v = M[4] + p[0] * M[2] - p[2] * M[0]
    w = M[5] + p[1] * M[0] - p[0] * M[1]
    return wp.matrix_from_rows(
        R[0, 0] * M[0] + R[1, 0] * M[1] + R[2, 0] * M[2],
        R[0, 1] * M[0] + R[1, 1] * M[1] + R[2, 1] * M[2],
        R[0, 2] * M[0] + R[1, 2] * M[1] + R[2, 2] * M[2],
        R[0, 0] * u + R[1, 0] * v + R[2, 0] * w,
        R[0, 1] * u + R[1, 1] * v + R[2, 1] * w,
        R[0, 2] * u + R[1, 2] * v + R[2, 2] * w,
    )


@wp.func
def propagated(P: Any, step: Pose):
    """Return F P F^T for a symmetric 6x6 matrix P, see `forward`."""
    return forward(step, wp.transpose(forward(step, P)))


@device_function
def odometry_noise(model: Any, i: int, dt: Any):
    """Return the variances (rotation, translation) per axis of an increment of vehicle i's odometry over dt."""
    scale = model.odometry_period * dt
    angular = wp.max(wp.float64(model.noise[i].angular_velocity), wp.float64(constants.MIN_ANGULAR_VELOCITY_STD))
    linear = wp.max(wp.float64(model.noise[i].velocity), wp.float64(constants.MIN_VELOCITY_STD))
    return vec2d(angular * angular * scale, linear * linear * scale)


@device_function
def averaging_time(model: Any, i: int):
    """Return the time, s, over which vehicle i averages a velocity that changes by `MAX_ACCELERATION` at most.

    Over a time t noise of density q has the variance q / (2 t), and the lag is a t: their sum is least at this one.
    """
    return wp.pow(odometry_noise(model, i, wp.float64(1.0))[1] * wp.float64(QUARTER), wp.float64(THIRD))


@wp.func
def with_noise(P: Any, noise: Any):
    """Return the symmetric part of P with variances (rotation, translation) added to its diagonal."""
    result = symmetric_part(P)
    for i in range(3):
        result[i, i] += noise[0]
        result[i + 3, i + 3] += noise[1]
    return result


@wp.func
def inflated(P: Any, share: Any):
    """Return P, 6x6, with a share of its diagonal added to the diagonal."""
    return P + wp.diag(share * wp.get_diag(P))


@wp.func
def carried(estimate: PoseEstimate, step: Pose, noise: Any):
    """Return an estimate after an increment of odometry with noise."""
    return PoseEstimate(moved(estimate.pose, step), with_noise(propagated(estimate.P, step), noise))


@wp.func
def is_known(P: Any):
    """Return whether the covariance P of a pose is small enough to linearise about it and to broadcast it."""
    for i in range(3):
        if not (P[i, i] < wp.float64(KNOWN_ANGLE_VARIANCE) and P[i + 3, i + 3] < wp.float64(KNOWN_POSITION_VARIANCE)):
            return False
    return True


@wp.func
def is_vague(P: Any):
    """Return whether the covariance P of a pose leaves its orientation open."""
    return wp.max(wp.max(P[0, 0], P[1, 1]), P[2, 2]) > wp.float64(VAGUE_ANGLE_VARIANCE)


@wp.func
def is_regular(M: Any, inverse: Any, most: Any):
    """Return whether tr(M) tr(M^-1) of a positive definite M, 6x6, is below `most`; False for NaN.

    The product is at least the condition number and at most 36 times it.
    """
    return wp.trace(M) * wp.trace(inverse) < most


@wp.func
def inverse_factor(A: Any):
    """Return the inverse of the Cholesky factor of a positive definite 6x6 matrix; NaN if it is not."""
    _, L21, _, I11, I22 = cholesky6(block3(A, 0, 0), block3(A, 0, 3), block3(A, 3, 3))
    return join6(I11, mat33d(), -(I22 * L21 * I11), I22)


@wp.func
def inverse6(A: Any):
    """Return the inverse of a positive definite 6x6 matrix; NaN if it is not."""
    X = inverse_factor(A)
    return wp.transpose(X) * X


@wp.func
def distance_squared(a: PoseEstimate, b: PoseEstimate):
    """Return the squared distance of two independent estimates, in standard deviations."""
    e = left_error(a.pose, b.pose)
    return wp.length_sq(inverse_factor(a.P + b.P) * e)
