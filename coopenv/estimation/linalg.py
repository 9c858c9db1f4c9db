"""Rotations, rigid motions and small matrices as Warp functions, generic in the precision.

R maps body to inertial coordinates; a held body twist (v, omega) moves the pose along
R(t) = R Exp(omega t), pbar(t) = pbar + R J_l(omega t) v t.
"""

from typing import Any

import warp as wp

# Quotients of literals inside a kernel would be rounded to float32; constants are not.
THIRD = wp.constant(1.0 / 3.0)
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


EPSILON64 = wp.constant(2.0**-52)
EPSILON32 = wp.constant(2.0**-23)
PIVOT_FLOOR = wp.constant(2.0**-7)
"""Smallest pivot of a Cholesky factor over the trace, in units of the machine epsilon."""
SWEEPS = wp.constant(12)  # at most; about five are needed


@wp.func
def epsilon(x: wp.float64):
    """Return the machine epsilon of the precision of `x`: the distance from 1 to the next larger number."""
    return wp.float64(EPSILON64)


@wp.func
def epsilon(x: wp.float32):  # noqa: F811 (an overload: Warp chooses by the type of the argument)
    """Return the machine epsilon of the precision of `x`: the distance from 1 to the next larger number."""
    return wp.float32(EPSILON32)


@wp.func
def symmetric_part(A: Any):
    """Return (A + A^T) / 2, exactly symmetric in floating point."""
    return (A + wp.transpose(A)) * A.dtype(0.5)


@wp.func
def cholesky3(A: Any):
    """Return (L, L^-1), both lower triangular, with A = L L^T, A symmetric positive definite and 3x3.

    Pivots that are lost in the rounding of A count as rounding, so that nothing is divided by zero.
    """
    o = A.dtype(0.0)
    one = A.dtype(1.0)
    tiny = wp.max(A.dtype(PIVOT_FLOOR) * epsilon(one) * wp.trace(A), A.dtype(1.0e-30))
    # The pivots of L D L^T first: a chain of quotients alone, the roots of which are then taken side by side.
    d0 = one / wp.max(A[0, 0], tiny)
    p1 = wp.max(A[1, 1] - A[1, 0] * (A[1, 0] * d0), tiny)
    d1 = one / p1
    u = A[2, 1] - A[2, 0] * (A[1, 0] * d0)
    p2 = wp.max(A[2, 2] - A[2, 0] * (A[2, 0] * d0) - u * (u * d1), tiny)
    i00 = wp.sqrt(d0)
    i11 = wp.sqrt(d1)
    i22 = wp.sqrt(one / p2)
    l10 = A[1, 0] * i00
    l20 = A[2, 0] * i00
    l21 = u * i11
    i10 = -l10 * i00 * i11
    i21 = -l21 * i11 * i22
    i20 = -(l20 * i00 + l21 * i10) * i22
    L = type(A)(A[0, 0] * i00, o, o, l10, p1 * i11, o, l20, l21, p2 * i22)
    return L, type(A)(i00, o, o, i10, i11, o, i20, i21, i22)


@wp.func
def cholesky6(A: Any, B: Any, D: Any):
    """Return (L11, L21, L22, L11^-1, L22^-1): the Cholesky factor of [[A, B], [B^T, D]] in blocks."""
    L11, I11 = cholesky3(A)
    L21 = wp.transpose(I11 * B)
    L22, I22 = cholesky3(D - L21 * wp.transpose(L21))
    return L11, L21, L22, I11, I22


@wp.func
def join6(A: Any, B: Any, C: Any, D: Any):
    """Return the 6x6 matrix [[A, B], [C, D]]."""
    M = wp.matrix(dtype=A.dtype, shape=(6, 6))
    M[:3, :3] = A
    M[:3, 3:] = B
    M[3:, :3] = C
    M[3:, 3:] = D
    return M


@wp.func
def block3(M: Any, row: int, column: int):
    """Return the 3x3 block of the 6x6 matrix M that starts at (row, column)."""
    A = wp.matrix(dtype=M.dtype, shape=(3, 3))
    for i in range(3):
        for j in range(3):
            A[i, j] = M[row + i, column + j]
    return A


@wp.func
def sheared(P: Any, S: Any):
    """Return T P T^T for a symmetric 6x6 matrix P and T = [[I, 0], [S, I]]."""
    SA = S * block3(P, 0, 0)
    SB = S * block3(P, 0, 3)
    B = block3(P, 0, 3) + wp.transpose(SA)
    D = block3(P, 3, 3) + SB + wp.transpose(SB) + SA * wp.transpose(S)
    return join6(block3(P, 0, 0), B, wp.transpose(B), D)


@wp.func
def jacobi_rotation(a_pp: Any, a_qq: Any, a_pq: Any):
    """Return (cosine, sine) of the plane rotation that annihilates a_pq (Golub and Van Loan, 8.5)."""
    one = type(a_pq)(1.0)
    theta = (a_qq - a_pp) / (type(a_pq)(2.0) * a_pq)
    tangent = one / (wp.abs(theta) + wp.sqrt(theta * theta + one))
    if theta < type(a_pq)(0.0):
        tangent = -tangent
    cosine = one / wp.sqrt(tangent * tangent + one)
    return cosine, tangent * cosine


@wp.func
def eigen_symmetric6(M: Any):
    """Return (D, U) with M = U D U^T, D diagonal up to rounding, by cyclic Jacobi sweeps.

    An entry is annihilated only if |a_pq| > eps sqrt(|a_pp a_qq|) (Demmel and Veselic 1992, Jacobi's method is more
    accurate than QR): within a repeated eigenvalue a_pp - a_qq is rounding alone, and a rotation by its angle, up to
    45 degrees, would undo the ones before it.
    """
    A = M
    U = wp.identity(n=6, dtype=M.dtype)
    rounding = epsilon(A[0, 0]) * epsilon(A[0, 0])
    for _ in range(SWEEPS):
        off = A.dtype(0.0)
        scale = A.dtype(0.0)
        for i in range(6):
            scale += A[i, i] * A[i, i]
            for j in range(i):
                off += A[i, j] * A[i, j]
        if off <= scale * rounding:
            break
        for p in range(5):
            for q in range(p + 1, 6):
                if A[p, q] * A[p, q] > wp.abs(A[p, p] * A[q, q]) * rounding:
                    c, s = jacobi_rotation(A[p, p], A[q, q], A[p, q])
                    for k in range(6):
                        akp = A[k, p]
                        akq = A[k, q]
                        A[k, p] = c * akp - s * akq
                        A[k, q] = s * akp + c * akq
                        ukp = U[k, p]
                        ukq = U[k, q]
                        U[k, p] = c * ukp - s * ukq
                        U[k, q] = s * ukp + c * ukq
                    row = A[p]
                    A[p] = c * row - s * A[q]
                    A[q] = s * row + c * A[q]
    return A, U


@wp.func
def tridiagonal6(M: Any):
    """Return (diagonal, squared off-diagonal) of Q^T M Q, M symmetric 6x6, by Householder reflections."""
    A = M
    w = A[0]
    diagonal = A[0]
    off = A[0]
    zero = A.dtype(0.0)
    for k in range(4):
        tail = zero
        for i in range(wp.static(k + 2), 6):
            tail += A[i, k] * A[i, k]
        head = A[k + 1, k]
        off[k] = head * head + tail
        if tail > zero:
            norm = wp.sqrt(off[k])
            if head > zero:
                norm = -norm
            beta = A.dtype(1.0) / (norm * (norm - head))
            A[k + 1, k] = head - norm  # the column below the diagonal is now the reflection's vector v
            along = zero
            for i in range(wp.static(k + 1), 6):
                total = zero
                for j in range(wp.static(k + 1), 6):
                    total += A[i, j] * A[j, k]
                w[i] = beta * total
                along += w[i] * A[i, k]
            along *= A.dtype(0.5) * beta
            for i in range(wp.static(k + 1), 6):
                w[i] -= along * A[i, k]
            for i in range(wp.static(k + 1), 6):
                for j in range(wp.static(k + 1), 6):
                    A[i, j] -= A[i, k] * w[j] + w[i] * A[j, k]
    for i in range(6):
        diagonal[i] = A[i, i]
    off[4] = A[5, 4] * A[5, 4]
    return diagonal, off


@wp.func
def smallest_eigenvalue6(M: Any):
    """Return the smallest eigenvalue of a positive semidefinite 6x6 matrix.

    Laguerre's iteration from 0 on the characteristic polynomial of the tridiagonal form: monotone, since all roots
    are real and lie to the right, and cubic near a simple root. The polynomials of the leading blocks are a Sturm
    sequence: as long as all are positive, no root lies to the left, also if rounding has made some below 0.
    """
    scale = wp.trace(M)
    zero = M.dtype(0.0)
    one = M.dtype(1.0)
    if scale <= zero:
        return zero
    d, e = tridiagonal6(M * (one / scale))
    rounding = M.dtype(0.1) * epsilon(one)  # of the entries of d, whose sum is 1
    x = zero
    for _ in range(30):
        p0 = one
        p = d[0] - x
        q0 = zero
        q = -one
        r0 = zero
        r = zero
        least = p
        for i in range(1, 6):
            factor = d[i] - x
            new_p = factor * p - e[i - 1] * p0
            new_q = factor * q - p - e[i - 1] * q0
            new_r = factor * r - M.dtype(2.0) * q - e[i - 1] * r0
            p0 = p
            q0 = q
            r0 = r
            p = new_p
            q = new_q
            r = new_r
            least = wp.min(least, p)
        if least <= zero:  # past the root by rounding: it has been found
            return wp.max(x, zero) * scale
        G = q / p
        H = G * G - r / p
        root = wp.sqrt(wp.max(M.dtype(5.0) * (M.dtype(6.0) * H - G * G), zero))
        step = M.dtype(6.0) / (root - G)
        x = x + step
        if step <= wp.max(x * M.dtype(1.0e-9), rounding):
            return wp.max(x, zero) * scale
    return wp.max(x, zero) * scale
