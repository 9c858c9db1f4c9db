"""The lens of a camera: image points, and the rays that they come from."""

import math
from collections.abc import Collection
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coopenv.base.errors import CoopenvError
from coopenv.cars.samples import Array, Calibration, Detections

CLOSE = 1e-9
"""Of image coordinates at distance 1: how near a ray's image has to be to the point that it was found for."""


def distort(points: Array, distortion: tuple[float, ...]) -> Array:
    """Return where a plumb-bob lens images points; both (m, 2), normalised (at distance 1)."""
    k1, k2, p1, p2, k3 = distortion
    x, y = points[:, 0], points[:, 1]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    dx = 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    dy = p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    return np.stack([x * radial + dx, y * radial + dy], axis=-1)


def undistort(points: Array, distortion: tuple[float, ...]) -> tuple[Array, NDArray[np.bool_]]:
    """Return the points without distortion, and which of them there are.

    Args:
        points: (m, 2) distorted, normalised.
        distortion: k1, k2, p1, p2, k3.

    Returns:
        (m, 2) undistorted points, and (m,) whether the lens images one at the given place: within the radius up to
        which distortion grows, and its image is the point again to 1e-9.
    """
    if not any(distortion):
        return points.copy(), np.asarray(np.isfinite(points).all(axis=-1))
    reach = largest_radius(distortion)
    found = _newton(points, points, distortion)
    there = _images(found, points, distortion, reach)
    if not there.all():  # far out Newton's method may leave the lens: begin where the radial part alone says
        again = _newton(_radially(points, distortion, reach), points, distortion)
        found = np.where(there[:, None], found, again)
        there = _images(found, points, distortion, reach)
    return found, there


@lru_cache(maxsize=64)
def largest_radius(distortion: tuple[float, ...]) -> float:
    """Return the radius up to which r (1 + k1 r^2 + k2 r^4 + k3 r^6) grows: farther rays would fold back."""
    k1, k2, _, _, k3 = distortion
    roots = np.roots([7 * k3, 0, 5 * k2, 0, 3 * k1, 0, 1.0]) if any((k1, k2, k3)) else np.array([])
    real = roots[np.abs(roots.imag) < 1e-9].real
    return float(real[real > 0].min(initial=math.inf))


def rays(pixels: Array, calibration: Calibration) -> tuple[Array, NDArray[np.bool_]]:
    """Return the rays of pixels.

    Args:
        pixels: (m, 2) to the right and down from the image's corner.
        calibration: of the camera.

    Returns:
        (m, 3) unit vectors in the optical frame, and (m,) which are rays: of pixels in the image that the lens gives.
    """
    size, focal, centre = (
        np.asarray(v, dtype=np.float64)
        for v in (calibration.image_size, calibration.focal_length, calibration.principal_point)
    )
    inside = ((pixels >= 0.0) & (pixels < size)).all(axis=-1)
    flat, there = undistort((pixels - centre) / focal, calibration.distortion)
    return directions(flat), inside & there


@lru_cache(maxsize=2**17)
def ray_of(calibration: Calibration, u: int, v: int) -> tuple[float, float, float] | None:
    """Return the ray of a whole pixel, as `rays` does; None: it has none. There are few enough to remember them all."""
    unit, there = rays(np.array([[u, v]], dtype=np.float64), calibration)
    x, y, z = unit[0].tolist()
    return (x, y, z) if there[0] else None


def directions(points: Array) -> Array:
    """Return the unit vectors (m, 3) through normalised image points (m, 2)."""
    through = np.concatenate([points, np.ones((len(points), 1))], axis=-1)
    unit: Array = through / np.linalg.norm(through, axis=-1, keepdims=True)
    return unit


def _images(found: Array, points: Array, distortion: tuple[float, ...], reach: float) -> NDArray[np.bool_]:
    with np.errstate(all="ignore"):
        near = np.abs(distort(found, distortion) - points).max(axis=-1, initial=0.0) <= CLOSE
        return np.asarray(near & ((found**2).sum(axis=-1) <= reach * reach))


def _newton(start: Array, points: Array, distortion: tuple[float, ...]) -> Array:
    """Return where Newton's method comes to from a start; (m, 2) each."""
    k1, k2, p1, p2, k3 = distortion
    found = start.copy()
    with np.errstate(all="ignore"):  # where it does not converge
        for _ in range(12):
            miss = distort(found, distortion) - points
            if not (np.abs(miss) > 1e-13).any():
                break
            x, y = found[:, 0], found[:, 1]
            r2 = x * x + y * y
            radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
            slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * k3 * r2))  # of `radial`, by x over x
            a = radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
            b = x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
            d = radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
            ex, ey = miss[:, 0], miss[:, 1]
            found = found - np.stack([d * ex - b * ey, a * ey - b * ex], axis=-1) / (a * d - b * b)[:, None]
    return found


def _radially(points: Array, distortion: tuple[float, ...], reach: float) -> Array:
    """Return undistorted points (m, 2) if distortion were radial alone, by bisection."""
    only = (distortion[0], distortion[1], 0.0, 0.0, distortion[4])
    radius = np.linalg.norm(points, axis=-1)

    def imaged(r: Array) -> Array:
        return distort(np.stack([r, np.zeros_like(r)], axis=-1), only)[:, 0]

    low, high = np.zeros_like(radius), np.minimum(radius + 1.0, reach)
    with np.errstate(all="ignore"):
        for _ in range(40):  # a lens whose distortion grows without end
            high = np.minimum(np.where(imaged(high) < radius, 2.0 * high, high), reach)
        for _ in range(60):
            middle = 0.5 * (low + high)
            short = imaged(middle) < radius
            low, high = np.where(short, middle, low), np.where(short, high, middle)
        start: Array = points * (low / np.maximum(radius, 1e-300))[:, None]
    return start


MOST = 1000
"""Blocks of a frame."""

UNIT = 1e-3
"""How far from 1 the length of a bearing may be."""


def detections(message: Any, calibration: Calibration, known: Collection[int] | None) -> Detections:
    """Return the bearings of an ObjectInfoArrayStamped, by the largest block of each marker.

    Dropped and counted: other blocks of a marker, those of unknown markers, without an area, or outside the image.
    """
    blocks = _few(message.objects, "objects")
    width, height = calibration.image_size
    best: dict[int, tuple[int, tuple[float, float, float]]] = {}  # marker to area and ray
    for block in blocks:
        u, v, marker = int(block.center_x), int(block.center_y), int(block.signature)
        if not (0 <= u < width and 0 <= v < height and block.width >= 0 and block.height >= 0):
            continue
        if known is not None and marker not in known:
            continue
        area, ray = int(block.width) * int(block.height), ray_of(calibration, u, v)
        if ray is not None and (marker not in best or area > best[marker][0]):
            best[marker] = area, ray
    unit = np.array([best[marker][1] for marker in sorted(best)], dtype=np.float64).reshape(-1, 3)
    return Detections(tuple(sorted(best)), unit, len(blocks) - len(best))


def bearings(message: Any, calibration: Calibration | None, known: Collection[int] | None) -> Detections:
    """Return the bearings of an ObjectBearingArrayStamped, whose vectors point from the target to the camera.

    Args:
        message: of the authors' node, which keeps the order of the camera, largest block first: the first counts.
        calibration: of the camera if distortion was not removed from the pixels of the vectors: then they give back
            the pixels. None: it was.
        known: markers that there are (None: all).

    Dropped and counted: later ones of a marker, those of unknown markers, without length 1, and with a calibration
    those outside the image.
    """
    rows = [(b.id, b.bearing_x, b.bearing_y, b.bearing_z) for b in _few(message.bearing, "bearing")]
    table = np.array(rows, dtype=np.float64).reshape(-1, 4)
    with np.errstate(all="ignore"):
        rays_ = -table[:, 1:]
        lengths = np.linalg.norm(rays_, axis=-1)
        there = np.abs(lengths - 1.0) <= UNIT
        rays_ /= lengths[:, None]
        if calibration is not None:
            there &= rays_[:, 2] > 1e-6
            flat = np.where(there[:, None], rays_[:, :2] / rays_[:, 2:], 0.0)
            pixels = flat * calibration.focal_length + np.asarray(calibration.principal_point)
            rays_, imaged = rays(np.round(pixels, 3), calibration)  # of single precision
            there &= imaged
    return _frame(table[:, 0].astype(np.int64), rays_, there, -np.arange(len(table), dtype=np.float64), known)


def _few(entries: Any, field: str) -> Any:
    if len(entries) > MOST:
        raise CoopenvError(f"{field}: {len(entries)} entries, a camera has at most {MOST}")
    return entries


def _frame(
    markers: NDArray[np.int64], unit: Array, there: NDArray[np.bool_], size: Array, known: Collection[int] | None
) -> Detections:
    """Return a frame with the largest entry of each marker among those that are `there`, in the order of markers."""
    best: dict[int, int] = {}
    for i in np.flatnonzero(there):
        marker = int(markers[i])
        if (known is None or marker in known) and (marker not in best or size[i] > size[best[marker]]):
            best[marker] = int(i)
    chosen = [best[marker] for marker in sorted(best)]
    return Detections(tuple(sorted(best)), unit[chosen].reshape(-1, 3), len(markers) - len(chosen))
