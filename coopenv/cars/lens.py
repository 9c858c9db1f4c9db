"""The lens of a camera: image points, and the rays that they come from."""

from collections.abc import Collection
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coopenv.base.errors import CoopenvError
from coopenv.cars.samples import Array, Calibration, Detections
from coopenv.estimation.lens import undistort


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
