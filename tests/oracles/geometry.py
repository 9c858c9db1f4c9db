"""Camera and occlusion geometry: pinhole field of view, plumb_bob distortion, segment against oriented box.

The occlusion test asks how far inside a box a segment comes: the depth of a point is the smallest of its
six signed distances to the faces (positive inside), concave along the segment, and its maximum is found by
enumerating the breakpoints. The segment passes through the open box when that depth is positive; its size
says how far the case is from grazing.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

#: Columns are the optical axes (x right, y down, z forward) in the body frame (x forward, y left, z up).
OPTICAL_TO_BODY_FORWARD: Array = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def point_in_camera(
    target: ArrayLike,
    R: ArrayLike,
    position: ArrayLike,
    lever_arm: ArrayLike = (0.0, 0.0, 0.0),
    optical_to_body: ArrayLike = OPTICAL_TO_BODY_FORWARD,
) -> Array:
    """Return inertial points (..., 3) in the optical frame of a camera at body point `lever_arm`."""
    in_body = (np.asarray(target, float) - np.asarray(position, float)) @ np.asarray(R, float)
    return (in_body - np.asarray(lever_arm, float)) @ np.asarray(optical_to_body, float)


def project(point: ArrayLike, fx: float, fy: float, cx: float, cy: float, distortion: ArrayLike = ()) -> Array:
    """Return the pixels (..., 2) of optical-frame points (..., 3); NaN for points that are not in front."""
    point = np.asarray(point, float)
    with np.errstate(divide="ignore", invalid="ignore"):
        xy = np.where(point[..., 2:] > 0.0, point[..., :2] / point[..., 2:], np.nan)
    if np.size(distortion):
        xy = distort_plumb_bob(xy, distortion)
    return xy * np.array([fx, fy]) + np.array([cx, cy])


def in_field_of_view(
    point: ArrayLike,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    width: float,
    height: float,
    distortion: ArrayLike = (),
) -> NDArray[np.bool_]:
    """Tell which optical-frame points (..., 3) are in front with 0 <= u < width and 0 <= v < height."""
    uv = project(point, fx, fy, cx, cy, distortion)
    return (uv >= 0.0).all(axis=-1) & (uv[..., 0] < width) & (uv[..., 1] < height)


def distort_plumb_bob(xy: ArrayLike, coefficients: ArrayLike) -> Array:
    """Apply the plumb_bob model (k1, k2, p1, p2, k3) to normalised image points (..., 2)."""
    k1, k2, p1, p2, k3 = np.resize(np.append(np.asarray(coefficients, float), np.zeros(5)), 5)
    x, y = np.moveaxis(np.asarray(xy, float), -1, 0)
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    x_distorted = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    y_distorted = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    return np.stack([x_distorted, y_distorted], axis=-1)


def depth_by_enumeration(
    start: ArrayLike, end: ArrayLike, centre: ArrayLike, R: ArrayLike, half_extents: ArrayLike
) -> Array:
    """Return the depth of segments in boxes, over leading axes: the best breakpoint of the six lines."""
    centre, R = np.asarray(centre, float), np.asarray(R, float)  # box axes to inertial axes
    ends = (np.einsum("...ji,...j->...i", R, np.asarray(point, float) - centre) for point in (start, end))
    a, b, half = np.broadcast_arrays(*ends, np.asarray(half_extents, float))
    at_start = np.concatenate([half - a, half + a], axis=-1)  # signed distances to the six faces
    slope = np.concatenate([a - b, b - a], axis=-1)
    candidates = [np.zeros(a.shape[:-1]), np.ones(a.shape[:-1])]
    for i, j in combinations(range(6), 2):
        with np.errstate(divide="ignore", invalid="ignore"):
            s = (at_start[..., j] - at_start[..., i]) / (slope[..., i] - slope[..., j])
        candidates.append(np.clip(np.nan_to_num(s, nan=0.0, posinf=1.0, neginf=0.0), 0.0, 1.0))
    s = np.stack(candidates, axis=-1)[..., None]
    return (at_start[..., None, :] + s * slope[..., None, :]).min(axis=-1).max(axis=-1)


def is_occluded(
    start: ArrayLike, end: ArrayLike, centre: ArrayLike, R: ArrayLike, half_extents: ArrayLike
) -> NDArray[np.bool_]:
    """Tell whether segments pass through the inside of boxes, broadcast over leading axes."""
    return depth_by_enumeration(start, end, centre, R, half_extents) > 0.0
