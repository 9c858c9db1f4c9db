"""The distances to three points from their bearings (P3P). See observers/perspective.py, which this follows.

The cubic is solved in closed form and its singular member's eigenvectors are found from its null space; Newton steps
on the squared sides bring the solutions to rounding.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from coopenv.estimation.p3p import FLAT, NEWTON_STEPS, TOLERANCE
from coopenv.observers.robust.conics import directions_in, null_vector, plane_slopes, singular_member, unit_matrix
from coopenv.observers.robust.types import mat33d, mat43d, vec3d

FLAT_TRIANGLE = FLAT
STEPS = NEWTON_STEPS
MOST_MISFIT = TOLERANCE
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
    for _ in range(STEPS):
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
def side_form(a: Any, b: Any, c: Any, x: Any, y: Any, z: Any):
    """Return the symmetric matrix with diagonal (a, b, c) and entries x at (0, 1), y at (0, 2), z at (1, 2)."""
    return mat33d(a, x, y, x, b, z, y, z, c)


@wp.func
def distances_of(a: Any, gaps: Any):
    """Return four rows of distances, not numbers where there is no solution; a: squared sides, of longest 1."""
    one = wp.float64(1.0)
    o = wp.float64(0.0)
    half = wp.float64(0.5)
    x = half * gaps[0] - one
    y = half * gaps[1] - one
    z = half * gaps[2] - one
    M01 = side_form(one, one, o, x, o, o)
    M02 = side_form(one, o, one, o, y, o)
    M12 = side_form(o, one, one, o, o, z)
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
def axes_of(a: Any, b: Any, c: Any):
    """Return the right-handed axes, as columns, of a triangle."""
    x = wp.normalize(b - a)
    normal = wp.normalize(wp.cross(x, c - a))
    return wp.matrix_from_cols(x, wp.cross(normal, x), normal)


@wp.func
def is_sound(b0: Any, b1: Any, b2: Any, z0: Any, z1: Any, z2: Any, longest: Any):
    """Return whether three points make a triangle and the bearings are unit vectors."""
    area = wp.length(wp.cross(z1 - z0, z2 - z0))
    if not (area > wp.float64(FLAT_TRIANGLE) * longest and wp.isfinite(longest)):
        return False
    worst = wp.max(wp.abs(wp.dot(b0, b0) - wp.float64(1.0)), wp.abs(wp.dot(b1, b1) - wp.float64(1.0)))
    worst = wp.max(worst, wp.abs(wp.dot(b2, b2) - wp.float64(1.0)))
    return worst < wp.float64(1.0e-3)


@wp.func
def solves(d: Any, gaps: Any, a: Any):
    """Return whether distances solve the problem."""
    f = misfit(d, gaps, a)
    missed = wp.max(wp.max(wp.abs(f[0]), wp.abs(f[1])), wp.abs(f[2]))
    o = wp.float64(0.0)
    return d[0] > o and d[1] > o and d[2] > o and missed < wp.float64(MOST_MISFIT)


@wp.func
def solutions_of(a: Any, gaps: Any):
    """Return how many solutions there are, and their distances, row by row, nearest to the first point first."""
    rows = distances_of(a, gaps)
    result = mat43d()
    count = int(0)
    for n in range(4):
        d = polished(rows[n], gaps, a)
        if solves(d, gaps, a):
            member = count
            while member > 0 and d[0] < result[wp.max(member - 1, 0), 0]:
                result[member] = result[member - 1]
                member -= 1
            result[member] = d
            count += 1
    return count, result
