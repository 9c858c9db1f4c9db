"""Where two cones meet: the planes of their pencil, and the directions in them, see p3p.py."""

from typing import Any

import warp as wp

from coopenv.observers.robust.memory import vec2d, vec3d

THIRD_TURN = 2.0943951023931953
THIRD = 1.0 / 3.0


@wp.func
def unit_matrix(M: Any):
    """Return a 3x3 matrix of Frobenius norm 1."""
    return M / wp.sqrt(wp.ddot(M, M))


@wp.func
def cofactors(M: Any):
    """Return the matrix of cofactors: its scalar product with X is the derivative of det M along X."""
    return wp.matrix_from_rows(wp.cross(M[1], M[2]), wp.cross(M[2], M[0]), wp.cross(M[0], M[1]))


@wp.func
def cubic_roots(c3: Any, c2: Any, c1: Any, c0: Any):
    """Return the three real roots of a cubic, or three times its only one."""
    b = c2 / c3 * wp.float64(THIRD)
    p = c1 / c3 * wp.float64(THIRD) - b * b
    q = b * b * b - wp.float64(0.5) * b * (c1 / c3) + wp.float64(0.5) * c0 / c3
    discriminant = q * q + p * p * p
    if discriminant <= wp.float64(0.0):
        radius = wp.sqrt(-p)
        cosine = -q / wp.max(radius * radius * radius, wp.float64(1.0e-300))
        angle = wp.acos(wp.clamp(cosine, wp.float64(-1.0), wp.float64(1.0))) * wp.float64(THIRD)
        radius = wp.float64(2.0) * radius
        return vec3d(
            radius * wp.cos(angle) - b,
            radius * wp.cos(angle + wp.float64(THIRD_TURN)) - b,
            radius * wp.cos(angle - wp.float64(THIRD_TURN)) - b,
        )
    large = wp.abs(q) + wp.sqrt(discriminant)
    root = wp.pow(large, wp.float64(THIRD))
    if q > wp.float64(0.0):
        root = -root
    x = root - p / root - b
    return vec3d(x, x, x)


@wp.func
def singular_member(S: Any, T: Any):
    """Return gamma with T + gamma S a pair of real planes, the most clearly so if there are several.

    Without one, the member's eigenvalues have one sign, and what follows is not a number.
    """
    c3 = wp.determinant(S)
    c2 = wp.ddot(cofactors(S), T)
    c1 = wp.ddot(cofactors(T), S)
    c0 = wp.determinant(T)
    roots = cubic_roots(c3, c2, c1, c0)
    best = wp.float64(wp.inf)
    chosen = roots[0]
    for n in range(3):
        x = roots[n]
        for _ in range(2):
            slope = (wp.float64(3.0) * c3 * x + wp.float64(2.0) * c2) * x + c1
            if slope != wp.float64(0.0):
                x = x - (((c3 * x + c2) * x + c1) * x + c0) / slope
        member = unit_matrix(T + x * S)
        trace = wp.trace(member)
        product = trace * trace - wp.ddot(member, member)  # twice that of the two eigenvalues that are not 0
        if product < best:
            best = product
            chosen = x
    return chosen


@wp.func
def null_vector(M: Any):
    """Return the unit vector that a singular symmetric matrix maps to 0."""
    C = cofactors(M)
    best = C[0]
    for n in range(2):
        if wp.dot(C[n + 1], C[n + 1]) > wp.dot(best, best):
            best = C[n + 1]
    return wp.normalize(best)


@wp.func
def plane_slopes(M: Any, null: Any):
    """Return the two directions that span, each with the null vector, the planes of a singular symmetric matrix."""
    axis = vec3d(wp.float64(1.0), wp.float64(0.0), wp.float64(0.0))
    if wp.abs(null[0]) > wp.float64(0.7):
        axis = vec3d(wp.float64(0.0), wp.float64(1.0), wp.float64(0.0))
    u = wp.normalize(wp.cross(null, axis))
    w = wp.cross(null, u)
    A = wp.dot(u, M * u)
    B = wp.dot(u, M * w)
    C = wp.dot(w, M * w)
    half = wp.float64(0.5) * (A - C)
    middle = wp.float64(0.5) * (A + C)
    radius = wp.sqrt(half * half + B * B)
    angle = wp.float64(0.5) * wp.atan2(B, half)
    high = wp.cos(angle) * u + wp.sin(angle) * w
    low = wp.cross(null, high)
    slope = wp.sqrt((radius - middle) / (radius + middle))
    return wp.normalize(low + slope * high), wp.normalize(low - slope * high)


@wp.func
def directions_in(plane: Any, null: Any, cone: Any):
    """Return the two directions (x, y) in a plane, along (null, plane), on a cone; not numbers if there are none."""
    a = wp.dot(null, cone * null)
    b = wp.dot(null, cone * plane)
    c = wp.dot(plane, cone * plane)
    discriminant = b * b - a * c
    if wp.abs(discriminant) < wp.float64(1.0e-12):  # a double solution, but for rounding
        discriminant = wp.float64(0.0)
    root = wp.sqrt(discriminant)
    q = -(b + wp.where(b < wp.float64(0.0), -root, root))
    return vec2d(q, a), vec2d(c, q)
