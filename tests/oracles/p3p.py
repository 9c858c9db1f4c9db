"""The pose from three bearings to known points (P3P): every solution, in closed form, for many triples at once.

Source: Persson and Nordberg, Lambda Twist: An accurate fast robust perspective three point (P3P) solver, ECCV 2018. The
distances l (3,) to the points satisfy l^T M_ij l = a_ij, where a_ij = |z_i - z_j|^2 and M_ij holds the cosine between
the bearings. Two combinations without right hand side are cones; one of their pencil is a pair of planes (a root of a
cubic), and in each plane the other cone leaves a quadratic. Here the cubic is an eigenvalue problem and the quadratic
is homogeneous, so that neither needs a leading coefficient.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from coopenv.estimation.arrays import Array

FIRST, SECOND = np.array([0, 0, 1]), np.array([1, 2, 2])
"""The pairs of points (0, 1), (0, 2), (1, 2)."""
ANGLES = np.arange(4) * np.pi / 4
NEWTON_STEPS = 3
TOLERANCE = 1e-8
"""What a solution may miss of the squared sides, relative to the longest."""
FLAT = 1e-9
"""Twice a triangle's area over its longest squared side: below it the points are on a line."""


def solve_p3p(bearings: Array, positions: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return every pose from which three points are seen in three directions, for each of B triples.

    Args:
        bearings: (B, 3, 3) unit vectors from the camera to the points, body frame, one a row.
        positions: (B, 3, 3) the points, map frame, m, one a row.

    Returns:
        Rotations (B, 4, 3, 3) from body to map, camera positions (B, 4, 3) in the map frame, and a mask (B, 4) of what
        is a solution, ordered by distance from the first point; the rest is NaN. A double one may come twice. None for
        degenerate input: points on a line, bearings not of length 1, values that are not finite.
    """
    b, z = np.asarray(bearings, dtype=np.float64), np.asarray(positions, dtype=np.float64)
    with np.errstate(all="ignore"):
        sides = ((z[:, FIRST] - z[:, SECOND]) ** 2).sum(-1)
        longest = sides.max(-1)
        sound = (_doubled_area(z) > FLAT * longest) & np.isfinite(longest)
        sound &= (np.abs((b * b).sum(-1) - 1.0) < 1e-3).all(-1)
        b = np.where(sound[:, None, None], b, np.eye(3))
        a = np.where(sound[:, None], sides / longest[:, None], 1.0)
        gaps = ((b[:, FIRST] - b[:, SECOND]) ** 2).sum(-1)
        distances = _polished(_distances(a, 1.0 - gaps / 2), gaps, a)
        distances = np.take_along_axis(distances, distances[..., :1].argsort(axis=1), axis=1)
        missed = np.abs(_misfit(distances, gaps[:, None], a[:, None])).max(-1)
        mask = sound[:, None] & (distances > 0.0).all(-1) & (missed < TOLERANCE)
        points = (distances * np.sqrt(longest)[:, None, None])[..., None] * b[:, None]
        R = _axes(z)[:, None] @ np.swapaxes(_axes(points), -1, -2)
        c = z.mean(1)[:, None] - (R @ points.mean(2)[..., None])[..., 0]
        mask &= np.isfinite(R).all((2, 3)) & np.isfinite(c).all(2)
    return np.where(mask[..., None, None], R, np.nan), np.where(mask[..., None], c, np.nan), mask


def _distances(a: Array, cosines: Array) -> Array:
    """Return (B, 4, 3) the distances to the points, NaN where there is none, for squared sides a (B, 3)."""
    M = np.zeros((len(a), 3, 3, 3))
    pair = np.arange(3)
    M[:, pair, FIRST, FIRST] = M[:, pair, SECOND, SECOND] = 1.0
    M[:, pair, FIRST, SECOND] = M[:, pair, SECOND, FIRST] = -cosines
    sides = a[:, :, None, None]
    D1 = M[:, 0] * sides[:, 2] - M[:, 2] * sides[:, 0]
    D2 = M[:, 1] * sides[:, 2] - M[:, 2] * sides[:, 1]
    planes, cone = _plane_pair(_unit(D1), _unit(D2))
    # in the plane of v and w: form (x, y)^T Q (x, y) = 0
    Q = np.swapaxes(planes, -1, -2) @ cone[:, None] @ planes
    A, B, C = Q[..., 0, 0], Q[..., 0, 1], Q[..., 1, 1]
    discriminant = B * B - A * C
    discriminant = np.where(np.abs(discriminant) < 1e-12, 0.0, discriminant)  # a double solution, but for rounding
    q = -(B + np.copysign(np.sqrt(discriminant), B))
    roots = np.stack([np.stack([q, A], -1), np.stack([C, q], -1)], -2)
    along = (roots @ np.swapaxes(planes, -1, -2)).reshape(-1, 4, 3)
    along *= np.sign(along.sum(-1, keepdims=True))
    squared = _misfit(along, 2.0 * (1.0 - cosines)[:, None], np.zeros(3)).sum(-1)
    result: Array = along * np.sqrt(a.sum(-1)[:, None] / squared)[..., None]
    return result


def _plane_pair(D1: Array, D2: Array) -> tuple[Array, Array]:
    """Return the spans (B, 2, 3, 2) of the planes in the pencil of two cones, and the cone (B, 3, 3) across it.

    NaN where no member of the pencil is a pair of real planes: then the cones do not meet.
    """
    # A cubic form has three roots at most, so one of four members of the pencil is regular unless all are singular.
    cos, sin = np.cos(ANGLES)[:, None, None], np.sin(ANGLES)[:, None, None]
    best = np.abs(np.linalg.det(cos * D1[:, None] + sin * D2[:, None])).argmax(-1)
    cos, sin = cos[best], sin[best]
    S, T = cos * D1 + sin * D2, cos * D2 - sin * D1
    regular = np.abs(np.linalg.det(S)) > 1e-14
    S = np.where(regular[:, None, None], S, np.eye(3))
    gamma = -np.linalg.eigvals(np.linalg.solve(S, T))  # det(T + gamma S) = 0
    members = _unit(T[:, None] + gamma.real[..., None, None] * S[:, None])
    trace = np.trace(members, axis1=-2, axis2=-1)
    product = (trace**2 - (members**2).sum((-1, -2))) / 2  # of the two eigenvalues that are not 0
    chosen = np.where(gamma.imag == 0.0, product, np.inf).argmin(-1)
    row = np.arange(len(S))
    values, vectors = np.linalg.eigh(members[row, chosen])
    low, null, high = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    slope = np.sqrt(-values[:, 0] / values[:, 2])[:, None]
    planes = np.stack([np.stack([null, _unit_rows(low + sign * slope * high)], -1) for sign in (1.0, -1.0)], 1)
    root = gamma.real[row, chosen][:, None, None]
    return np.where(regular[:, None, None, None], planes, np.nan), _unit(S - root * T)


def _misfit(distances: Array, gaps: Array, a: Array) -> Array:
    """Return (..., 3) the squared sides that distances (..., 3) make, less those of the triangle.

    With gaps |b_i - b_j|^2 for the cosines, small angles keep their digits.
    """
    first, second = distances[..., FIRST], distances[..., SECOND]
    return (first - second) ** 2 + first * second * gaps - a


def _polished(distances: Array, gaps: Array, a: Array) -> Array:
    """Return distances (B, 4, 3) after Newton steps on the squared sides; a step that makes no better is not taken."""
    gaps, a = gaps[:, None], a[:, None]
    f = _misfit(distances, gaps, a)
    for _ in range(NEWTON_STEPS):
        first, second = distances[..., FIRST], distances[..., SECOND]
        by_first, by_second = 2 * (first - second) + second * gaps, 2 * (second - first) + first * gaps
        p, r, t = by_first[..., 0], by_first[..., 1], by_first[..., 2]  # rows (p, q, 0), (r, 0, s), (0, t, u)
        q, s, u = by_second[..., 0], by_second[..., 1], by_second[..., 2]
        f0, f1, f2 = f[..., 0], f[..., 1], f[..., 2]
        determinant = -(p * s * t + q * r * u)
        step = np.stack(
            [
                -s * t * f0 - q * u * f1 + q * s * f2,
                -r * u * f0 + p * u * f1 - p * s * f2,
                r * t * f0 - p * t * f1 - q * r * f2,
            ],
            axis=-1,
        )
        moved = distances - step / determinant[..., None]
        f_moved = _misfit(moved, gaps, a)
        better = ((f_moved**2).sum(-1) < (f**2).sum(-1))[..., None]
        if not better.any():
            break
        distances, f = np.where(better, moved, distances), np.where(better, f_moved, f)
    return distances


def _axes(points: Array) -> Array:
    """Return (..., 3, 3) the right-handed axes, as columns, of triangles (..., 3, 3) of one point a row."""
    x = _unit_rows(points[..., 1, :] - points[..., 0, :])
    normal = _unit_rows(_cross(x, points[..., 2, :] - points[..., 0, :]))
    return np.stack([x, _cross(normal, x), normal], axis=-1)


def _doubled_area(points: Array) -> Array:
    """Return (B,) twice the areas of triangles (B, 3, 3)."""
    n = _cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
    result: Array = np.sqrt((n * n).sum(-1))
    return result


def _cross(a: Array, b: Array) -> Array:
    """Return a x b (..., 3); np.cross takes several times as long on small arrays."""
    return a[..., [1, 2, 0]] * b[..., [2, 0, 1]] - a[..., [2, 0, 1]] * b[..., [1, 2, 0]]


def _unit(D: Array) -> Array:
    """Return matrices (..., 3, 3) of Frobenius norm 1."""
    result: Array = D / np.sqrt((D * D).sum((-1, -2), keepdims=True))
    return result


def _unit_rows(v: Array) -> Array:
    """Return vectors (..., 3) of length 1."""
    result: Array = v / np.sqrt((v * v).sum(-1, keepdims=True))
    return result
