"""The pose from three bearings to known points (P3P): every solution, in closed form.

Source: Persson and Nordberg, Lambda Twist: An accurate fast robust perspective three point (P3P) solver, ECCV 2018. The
distances l (3,) to the points satisfy l^T M_ij l = a_ij, where a_ij = |z_i - z_j|^2 and M_ij holds the cosine between
the bearings. Two combinations without right hand side are cones; one of their pencil is a pair of planes (a root of a
cubic), and in each plane the other cone leaves a quadratic. Newton steps on the squared sides bring the solutions to
rounding; with gaps |b_i - b_j|^2 for the cosines, small angles keep their digits.
"""

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from coopenv.estimation.linalg import THIRD
from coopenv.estimation.poses import Array
from coopenv.world import launch
from coopenv.world.launch import kernel, start_warp

vec2d: Any = wp.vec2d
vec3d: Any = wp.vec3d
mat33d: Any = wp.mat33d
mat43d: Any = wp.types.matrix((4, 3), wp.float64)

THIRD_TURN = 2.0943951023931953


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


NEWTON_STEPS = 3
TOLERANCE = 1e-8  # largest misfit of a solution's squared sides, relative to the longest
FLAT = 1e-9  # twice a triangle's area over its longest squared side: below it the points are on a line
EIGHTH_TURN = 0.7853981633974483


@wp.func
def misfit(d: Any, gaps: Any, a: Any):
    """Return the squared sides that distances make, less those of the triangle: pairs (0, 1), (0, 2), (1, 2)."""
    return vec3d(
        (d[0] - d[1]) * (d[0] - d[1]) + d[0] * d[1] * gaps[0] - a[0],
        (d[0] - d[2]) * (d[0] - d[2]) + d[0] * d[2] * gaps[1] - a[1],
        (d[1] - d[2]) * (d[1] - d[2]) + d[1] * d[2] * gaps[2] - a[2],
    )


@wp.func
def polished(distances: Any, gaps: Any, a: Any):
    """Return distances after Newton steps on the squared sides; a step that makes no better is not taken."""
    two = wp.float64(2.0)
    d = distances
    f = misfit(d, gaps, a)
    for _ in range(NEWTON_STEPS):
        p = two * (d[0] - d[1]) + d[1] * gaps[0]
        q = two * (d[1] - d[0]) + d[0] * gaps[0]
        r = two * (d[0] - d[2]) + d[2] * gaps[1]
        s = two * (d[2] - d[0]) + d[0] * gaps[1]
        t = two * (d[1] - d[2]) + d[2] * gaps[2]
        u = two * (d[2] - d[1]) + d[1] * gaps[2]
        step = vec3d(
            -s * t * f[0] - q * u * f[1] + q * s * f[2],
            -r * u * f[0] + p * u * f[1] - p * s * f[2],
            r * t * f[0] - p * t * f[1] - q * r * f[2],
        )
        moved = d + step / (p * s * t + q * r * u)
        f_moved = misfit(moved, gaps, a)
        if wp.dot(f_moved, f_moved) < wp.dot(f, f):
            d = moved
            f = f_moved
    return d


@wp.func
def scaled(direction: Any, plane: Any, null: Any, gaps: Any, perimeter: Any):
    """Return the distances along a direction that make the triangle as large as it is."""
    d = direction[0] * null + direction[1] * plane
    if d[0] + d[1] + d[2] < wp.float64(0.0):
        d = -d
    f = misfit(d, gaps, vec3d())
    return d * wp.sqrt(perimeter / (f[0] + f[1] + f[2]))


@wp.func
def distances_of(a: Any, gaps: Any):
    """Return four rows of distances, not numbers where there is no solution; a: squared sides, of longest 1."""
    i = wp.float64(1.0)
    o = wp.float64(0.0)
    half = wp.float64(0.5)
    x = half * gaps[0] - i
    y = half * gaps[1] - i
    z = half * gaps[2] - i
    M01 = mat33d(i, x, o, x, i, o, o, o, o)
    M02 = mat33d(i, o, y, o, o, o, y, o, i)
    M12 = mat33d(o, o, o, o, i, z, o, z, i)
    D1 = unit_matrix(a[2] * M01 - a[0] * M12)
    D2 = unit_matrix(a[2] * M02 - a[1] * M12)
    best = o
    S = D1
    T = D2
    for n in range(4):  # a cubic form has three roots at most, so one of four members is regular
        angle = wp.float64(n) * wp.float64(EIGHTH_TURN)
        member = wp.cos(angle) * D1 + wp.sin(angle) * D2
        size = wp.abs(wp.determinant(member))
        if size > best:
            best = size
            S = member
            T = wp.cos(angle) * D2 - wp.sin(angle) * D1
    result = mat43d()
    if best > wp.float64(1.0e-14):
        gamma = singular_member(S, T)
        member = unit_matrix(T + gamma * S)
        cone = unit_matrix(S - gamma * T)
        null = null_vector(member)
        first, second = plane_slopes(member, null)
        perimeter = a[0] + a[1] + a[2]
        d0, d1 = directions_in(first, null, cone)
        d2, d3 = directions_in(second, null, cone)
        result[0] = scaled(d0, first, null, gaps, perimeter)
        result[1] = scaled(d1, first, null, gaps, perimeter)
        result[2] = scaled(d2, second, null, gaps, perimeter)
        result[3] = scaled(d3, second, null, gaps, perimeter)
    return result


@wp.func
def is_valid(b: Any, z: Any, longest: Any):
    """Return whether three points make a triangle and the bearings are unit vectors."""
    area = wp.length(wp.cross(z[1] - z[0], z[2] - z[0]))
    if not (area > wp.float64(FLAT) * longest and wp.isfinite(longest)):
        return False
    lengths = vec3d(wp.dot(b[0], b[0]), wp.dot(b[1], b[1]), wp.dot(b[2], b[2]))
    return wp.max(wp.abs(lengths - vec3d(wp.float64(1.0)))) < wp.float64(1.0e-3)


@wp.func
def solve_triangle(b: Any, z: Any):
    """Return the number of solutions for bearings and points, rows, and the distances, the nearest first."""
    sides = vec3d(wp.length_sq(z[0] - z[1]), wp.length_sq(z[0] - z[2]), wp.length_sq(z[1] - z[2]))
    longest = wp.max(sides)
    count = int(0)
    result = mat43d()
    if is_valid(b, z, longest):
        a = sides / longest
        gaps = vec3d(wp.length_sq(b[0] - b[1]), wp.length_sq(b[0] - b[2]), wp.length_sq(b[1] - b[2]))
        rows = distances_of(a, gaps)
        for n in range(4):
            d = polished(rows[n], gaps, a)
            missed = wp.max(wp.abs(misfit(d, gaps, a)))
            if wp.min(d) > wp.float64(0.0) and missed < wp.float64(TOLERANCE):
                slot = count
                while slot > 0 and d[0] < result[wp.max(slot - 1, 0), 0]:
                    result[slot] = result[slot - 1]
                    slot -= 1
                result[slot] = d
                count += 1
    return count, result * wp.sqrt(longest)


@wp.func
def axes_of(a: Any, b: Any, c: Any):
    """Return the right-handed axes, as columns, of a triangle."""
    x = wp.normalize(b - a)
    normal = wp.normalize(wp.cross(x, c - a))
    return wp.matrix_from_cols(x, wp.cross(normal, x), normal)


@wp.func
def camera_pose(b: Any, z: Any, distances: Any):
    """Return the rotation and position of a camera from which three points are at these distances."""
    p0 = distances[0] * b[0]
    p1 = distances[1] * b[1]
    p2 = distances[2] * b[2]
    R = axes_of(z[0], z[1], z[2]) * wp.transpose(axes_of(p0, p1, p2))
    third = wp.float64(THIRD)
    return R, (z[0] + z[1] + z[2]) * third - R * ((p0 + p1 + p2) * third)


def p3p_kernel(bearings: Any, positions: Any, R: Any, camera: Any, mask: Any):
    """Solve one problem per thread."""
    n = wp.tid()
    count, distances = solve_triangle(bearings[n], positions[n])
    for s in range(count):
        turn, slot = camera_pose(bearings[n], positions[n], distances[s])
        if wp.isfinite(wp.ddot(turn, turn) + wp.dot(slot, slot)):
            R[n, s] = turn
            camera[n, s] = slot
            mask[n, s] = True


def solve_p3p(bearings: Array, positions: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return every pose from which three points are seen in three directions, for each of B triples.

    Bearings and positions (B, 3, 3) have a row each: unit vectors in the body frame, and points in the map, m.
    Rotations (B, 4, 3, 3) are from body to map, cameras (B, 4, 3) in the map; a mask (B, 4) says what is a solution,
    the nearest to the first point first; the rest is NaN. A double one may come twice. There are none for points on a
    line, bearings that are not of length 1, and what is not finite.
    """
    start_warp()
    b, z = (np.ascontiguousarray(given, dtype=np.float64) for given in (bearings, positions))
    R, camera, mask = np.full((len(b), 4, 3, 3), np.nan), np.full((len(b), 4, 3), np.nan), np.zeros((len(b), 4), bool)
    typed = ((b, mat33d), (z, mat33d), (R, mat33d), (camera, vec3d), (mask, wp.bool))
    views = [wp.array(array, dtype=dtype, device="cpu", copy=False) for array, dtype in typed]
    launch.launch(kernel(p3p_kernel, "float64"), dim=len(b), inputs=views, device="cpu")
    return R, camera, mask
