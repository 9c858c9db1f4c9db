"""Rotations and rigid motions as Warp functions, generic in the precision.

R maps body to inertial coordinates; a held body twist (v, omega) moves the pose along
R(t) = R Exp(omega t), pbar(t) = pbar + R J_l(omega t) v t.
"""

from typing import Any

import warp as wp

# Quotients of literals inside a kernel would be rounded to float32; constants are not.
SIXTH = wp.constant(1.0 / 6.0)
OVER_24 = wp.constant(1.0 / 24.0)
OVER_120 = wp.constant(1.0 / 120.0)
OVER_720 = wp.constant(1.0 / 720.0)
OVER_5040 = wp.constant(1.0 / 5040.0)


@wp.func
def skew(v: Any):
    """Return S(v) with S(v) y = v x y (paper, section Notation)."""
    o = v.dtype(0.0)
    return wp.matrix_from_rows(type(v)(o, -v[2], v[1]), type(v)(v[2], o, -v[0]), type(v)(-v[1], v[0], o))


@wp.func
def identity3(v: Any):
    """Return the 3x3 identity in the precision of the vector `v`."""
    o = v.dtype(0.0)
    i = v.dtype(1.0)
    return wp.matrix_from_rows(type(v)(i, o, o), type(v)(o, i, o), type(v)(o, o, i))


@wp.func
def rodrigues(square: Any):
    """Return (sin x / x, (1 - cos x) / x^2, (x - sin x) / x^3) of an angle x in rad, given x^2."""
    one = type(square)(1.0)
    # Series up to x^4: exact to rounding below 0.01 rad, where almost all steps lie, and free of trigonometry.
    a = one - square * (type(square)(SIXTH) - square * type(square)(OVER_120))
    b = type(square)(0.5) - square * (type(square)(OVER_24) - square * type(square)(OVER_720))
    c = type(square)(SIXTH) - square * (type(square)(OVER_120) - square * type(square)(OVER_5040))
    if square > type(square)(1.0e-4):
        angle = wp.sqrt(square)
        sine = wp.sin(angle)
        half = wp.sin(angle * type(square)(0.5))
        a = sine / angle
        b = type(square)(2.0) * half * half / square
        c = (angle - sine) / (square * angle)
    return a, b, c


@wp.func
def turn_by(w: Any, square: Any, a: Any, b: Any):
    """Return Exp(w) = (1 - b |w|^2) I + a S(w) + b w w^T, with a and b of `rodrigues`."""
    return (w.dtype(1.0) - b * square) * identity3(w) + a * skew(w) + b * wp.outer(w, w)


@wp.func
def exp_so3(w: Any):
    """Return Exp(w), the rotation by |w| rad about w (Rodrigues)."""
    square = wp.dot(w, w)
    a, b, _ = rodrigues(square)
    return turn_by(w, square, a, b)


@wp.func
def rigid_motion(w: Any, u: Any):
    """Return (Exp(w), J_l(w) u): the turn and the way of a body twist held while it turns by w rad and goes u m.

    J_l(w) = int_0^1 Exp(s w) ds turns a held velocity into a displacement.
    """
    square = wp.dot(w, w)
    a, b, c = rodrigues(square)
    across = wp.cross(w, u)
    return turn_by(w, square, a, b), u + b * across + c * wp.cross(w, across)


@wp.func
def orthonormalise(R: Any):
    """Return the rotation nearest to an almost orthogonal R, by one Newton step of the polar factor."""
    G = wp.transpose(R) * R
    return R.dtype(1.5) * R - R.dtype(0.5) * (R * G)


@wp.func
def rotation_vector_sine(R: Any):
    """Return the axis of R times the sine of its angle: the vector of the skew part of R."""
    h = R.dtype(0.5)
    return wp.vector((R[2, 1] - R[1, 2]) * h, (R[0, 2] - R[2, 0]) * h, (R[1, 0] - R[0, 1]) * h)


@wp.func
def rotation_angle(R: Any):
    """Return the geodesic angle of R in rad, accurate near 0 and near pi."""
    sine = wp.length(rotation_vector_sine(R))
    cosine = (wp.trace(R) - R.dtype(1.0)) * R.dtype(0.5)
    return wp.atan2(sine, cosine)


@wp.func
def quaternion_vector(R: Any):
    """Return lambda, the vector part of the unit quaternion of R with non-negative scalar part."""
    sine = rotation_vector_sine(R)  # axis sin(angle) = 2 scalar lambda
    scalar_squared = (R.dtype(1.0) + wp.trace(R)) * R.dtype(0.25)
    if scalar_squared > R.dtype(1.0e-2):
        return sine / (R.dtype(2.0) * wp.sqrt(scalar_squared))
    # Near half a turn the skew part vanishes: take the axis from the largest column of R + R^T.
    best = int(0)
    if R[1, 1] > R[0, 0]:
        best = int(1)
    if R[2, 2] > R[best, best]:
        best = int(2)
    column = wp.vector(R[0, best] + R[best, 0], R[1, best] + R[best, 1], R[2, best] + R[best, 2])
    shift = R.dtype(1.0) - wp.trace(R)
    column[best] = column[best] + shift
    axis = wp.normalize(column)
    if wp.dot(axis, sine) < R.dtype(0.0):
        axis = -axis
    return axis * wp.sqrt(wp.max(R.dtype(1.0) - scalar_squared, R.dtype(0.0)))


@wp.func
def increment(rotation: Any, translation: Any, v: Any, w: Any, dt: Any):
    """Append a body twist held for dt to the increment (dR, dp)."""
    turn, way = rigid_motion(w * dt, v * dt)
    return rotation * turn, translation + rotation * way
