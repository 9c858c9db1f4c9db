"""Distortion of image points by a lens, and its removal.

A model is known by the number of its coefficients, in OpenCV's order and with its equations: 5 (k1, k2, p1, p2, k3) are
plumb bob, 8 (and k4, k5, k6) rational, 4 (k1 to k4 of the angle) fisheye.
"""

import math
from functools import lru_cache

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import NDArray

from coopenv.estimation.poses import Array

FISHEYE = 4
"""Coefficients of a fisheye lens."""
PLUMB_BOB = ("k1", "k2", "p1", "p2", "k3")
COEFFICIENTS = {
    FISHEYE: ("k1", "k2", "k3", "k4"),
    len(PLUMB_BOB): PLUMB_BOB,
    8: (*PLUMB_BOB, "k4", "k5", "k6"),
}
"""Names of a lens's coefficients, by their number."""

SQUARE = Polynomial([0.0, 1.0])
"""The squared radius."""

CLOSE = 1e-9
"""Tolerance between a ray's image and its point, in image coordinates at distance 1."""


def distort(points: Array, distortion: tuple[float, ...]) -> Array:
    """Return the images of points by a lens; both (m, 2), normalised (at distance 1)."""
    x, y = points[:, 0], points[:, 1]
    r2 = x * x + y * y
    if len(distortion) == FISHEYE:
        r = np.sqrt(r2)
        angle = np.arctan(r)
        bent = angle * np.polynomial.polynomial.polyval(angle * angle, (1.0, *distortion))
        return np.asarray(points * np.divide(bent, r, out=np.ones_like(r), where=r > 0.0)[:, None])
    _, _, p1, p2 = distortion[:4]
    radial = _radial(r2, distortion)[0]
    dx = 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    dy = p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    return np.stack([x * radial + dx, y * radial + dy], axis=-1)


def _radial(r2: Array, distortion: tuple[float, ...]) -> tuple[Array, Array]:
    """Return the factor of the radius at squared radii, and its derivative by them."""
    k1, k2, _, _, k3, *more = distortion
    factor, slope = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3)), k1 + r2 * (2.0 * k2 + 3.0 * k3 * r2)
    if more:
        k4, k5, k6 = more
        below = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))
        factor = factor / below
        slope = (slope - factor * (k4 + r2 * (2.0 * k5 + 3.0 * k6 * r2))) / below
    return factor, slope


def undistort(points: Array, distortion: tuple[float, ...]) -> tuple[Array, NDArray[np.bool_]]:
    """Return the points without distortion, and which of them there are.

    Args:
        points: (m, 2) distorted, normalised.
        distortion: 4, 5 or 8 coefficients.

    Returns:
        (m, 2) undistorted points, and (m,) whether the lens images one at the given place: within the radius up to
        which distortion grows, and its image is the point again to 1e-9.
    """
    if not any(distortion):
        return points.copy(), np.asarray(np.isfinite(points).all(axis=-1))
    reach = largest_radius(distortion)
    if len(distortion) == FISHEYE:
        found = _radially(points, distortion, reach)
        return found, _images(found, points, distortion, reach)
    found = _newton(points, points, distortion)
    there = _images(found, points, distortion, reach)
    if not there.all():  # far out Newton's method may diverge: start from the solution of the radial part
        again = _newton(_radially(points, distortion, reach), points, distortion)
        found = np.where(there[:, None], found, again)
        there = _images(found, points, distortion, reach)
    return found, there


@lru_cache(maxsize=64)
def largest_radius(distortion: tuple[float, ...]) -> float:
    """Return the radius up to which the distorted radius grows: farther rays would fold back."""
    if len(distortion) == FISHEYE:
        k1, k2, k3, k4 = distortion
        return math.tan(min(_first_root([1.0, 3 * k1, 5 * k2, 7 * k3, 9 * k4]), 0.5 * math.pi))
    k1, k2, _, _, k3, *more = distortion
    above, below = Polynomial([1.0, k1, k2, k3]), Polynomial([1.0, *more])
    slope = above + 2.0 * SQUARE * above.deriv()
    growth = slope * below - 2.0 * SQUARE * above * below.deriv()
    return min(_first_root(growth.coef.tolist()), _first_root(below.coef.tolist()))


def _first_root(coefficients: list[float]) -> float:
    """Return the square root of the first positive root of a polynomial, lowest order first; inf: there is none."""
    roots = Polynomial(coefficients).trim().roots()
    real = roots[np.abs(roots.imag) < 1e-9].real
    return math.sqrt(float(real[real > 0].min(initial=math.inf)))


def _images(found: Array, points: Array, distortion: tuple[float, ...], reach: float) -> NDArray[np.bool_]:
    with np.errstate(all="ignore"):
        near = np.abs(distort(found, distortion) - points).max(axis=-1, initial=0.0) <= CLOSE
        return np.asarray(near & ((found**2).sum(axis=-1) <= reach * reach))


def _newton(start: Array, points: Array, distortion: tuple[float, ...]) -> Array:
    """Return the result of Newton's method from a start; (m, 2) each."""
    _, _, p1, p2 = distortion[:4]
    found = start.copy()
    with np.errstate(all="ignore"):  # where it does not converge
        for _ in range(12):
            miss = distort(found, distortion) - points
            if not (np.abs(miss) > 1e-13).any():
                break
            x, y = found[:, 0], found[:, 1]
            r2 = x * x + y * y
            radial, slope = _radial(r2, distortion)
            slope = 2.0 * slope  # of `radial`, by x over x
            a = radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
            b = x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
            d = radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
            ex, ey = miss[:, 0], miss[:, 1]
            found = found - np.stack([d * ex - b * ey, a * ey - b * ex], axis=-1) / (a * d - b * b)[:, None]
    return found


def _radially(points: Array, distortion: tuple[float, ...], reach: float) -> Array:
    """Return undistorted points (m, 2) if distortion were radial alone, by bisection."""
    only = distortion if len(distortion) == FISHEYE else (*distortion[:2], 0.0, 0.0, *distortion[4:])
    radius = np.linalg.norm(points, axis=-1)

    def imaged(r: Array) -> Array:
        return distort(np.stack([r, np.zeros_like(r)], axis=-1), only)[:, 0]

    low, high = np.zeros_like(radius), np.minimum(radius + 1.0, reach)
    with np.errstate(all="ignore"):
        for _ in range(40):  # the distortion of a lens may grow without end
            high = np.minimum(np.where(imaged(high) < radius, 2.0 * high, high), reach)
        for _ in range(60):
            middle = 0.5 * (low + high)
            short = imaged(middle) < radius
            low, high = np.where(short, middle, low), np.where(short, high, middle)
        start: Array = points * (low / np.maximum(radius, 1e-300))[:, None]
    return start
