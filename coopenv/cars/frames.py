"""Frames with tags: the renderer."""

from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter

from coopenv.base.errors import CoopenvError
from coopenv.cars.vision import Calibration, dictionary_of, opencv, rays
from coopenv.estimation.poses import Array

INSIDE = (np.stack(np.meshgrid(np.arange(4.0), np.arange(4.0)), axis=-1).reshape(-1, 2) - 1.5) / 4.0
"""Rays through a pixel, from its middle: downwards and to the right, in pixels."""

WHITE, BLACK, WALL, OUTSIDE = 220.0, 30.0, 120.0, -1.0
"""Shades of tags, of their background, and outside of tags."""


class PlacedTag(NamedTuple):
    """A tag in front of a camera."""

    number: int
    axes: Array  # (3, 3) columns: to its right, downwards and behind it, as its reader sees it; optical frame
    place: Array  # (3,) of its centre, optical frame, m
    side: float  # of its black square, m; a white border of one cell is around it


@cache
def pattern(family: str, number: int) -> Array:
    """Return the shades of the cells of a tag, border included. Raises CoopenvError: the family has no such number."""
    dictionary = dictionary_of(family)
    if not 0 <= number < (count := len(dictionary.bytesList)):
        raise CoopenvError(f"marker {number}: {family} has 0 to {count - 1}")
    cells = opencv().aruco.generateImageMarker(dictionary, number, dictionary.markerSize + 2)
    return np.where(np.pad(cells, 1, constant_values=255) > 127, WHITE, BLACK)


@cache
def pixel_rays(calibration: Calibration) -> tuple[Array, Array, Array]:
    """Return the rays (height, width, 3) of all pixels, at depth 1, and their changes downwards and to the right."""
    width, height = calibration.image_size
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 2)
    units, there = rays(pixels.astype(np.float64), calibration)
    units[~there] = np.nan  # meets no tag
    found = (units / units[:, 2:]).reshape(height, width, 3)
    return found, *np.gradient(found)[:2]  # per pixel: nearly the same all over it


def facing(number: int, place: Array, side: float) -> PlacedTag:
    """Return an upright tag that faces the camera; `place` (3,) is its centre, optical frame, m, `side` in m."""
    across = np.array([place[2], 0.0, -place[0]]) / np.hypot(place[0], place[2])
    axes = np.stack([across, [0.0, 1.0, 0.0], np.cross(across, [0.0, 1.0, 0.0])], axis=-1)
    return PlacedTag(number, axes, place, side)


class FrameRenderer:
    """Renders frames of one camera; pixels have whole numbers in their middle, as in OpenCV."""

    def __init__(self, calibration: Calibration, family: str) -> None:
        """Find the rays of all pixels."""
        self.calibration, self.family = calibration, family
        self._rays, self._down, self._right = pixel_rays(calibration)

    def render(
        self, tags: Sequence[PlacedTag], blur: float, noise: float, rng: np.random.Generator, behind: Any = WALL
    ) -> NDArray[np.uint8]:
        """Return a frame (height, width) of tags before shades of that size, or one shade.

        Blur is in pixels, noise in shades, standard deviations both.
        """
        frame = np.empty(self._rays.shape[:2], np.float32)
        frame[:] = behind
        for tag in sorted(tags, key=lambda tag: -float(np.linalg.norm(tag.place))):
            self._paint(frame, tag)
        if blur:
            frame = opencv().GaussianBlur(frame, (0, 0), blur)
        frame += np.float32(noise) * rng.standard_normal(frame.shape, np.float32)
        return np.asarray(np.rint(frame).clip(0, 255), dtype=np.uint8)

    def _paint(self, frame: NDArray[Any], tag: PlacedTag) -> None:
        shades = np.pad(pattern(self.family, tag.number), 1, constant_values=OUTSIDE)
        cells, cell = len(shades) - 2, tag.side / (len(shades) - 4)
        box = self._box(tag, 0.5 * cells * cell)
        if box is None:
            return
        n, p = tag.axes[:, 2], tag.place
        rows = [((n @ p) * a - (a @ p) * n) / cell + 0.5 * cells * n for a in tag.axes[:, :2].T]
        H = np.array([*rows, n])  # from rays to the cells, homogeneous
        middle, down, right = (part[box] @ H.T for part in (self._rays, self._down, self._right))
        behind, found = frame[box], shades[_cells(middle, cells)]
        mixed = maximum_filter(found, 3) != minimum_filter(found, 3)  # most pixels of a near tag have one shade
        through = middle[mixed, None] + INSIDE[:, :1] * down[mixed, None] + INSIDE[:, 1:] * right[mixed, None]
        fine = shades[_cells(through, cells)]
        found = np.where(found == OUTSIDE, behind, found)
        found[mixed] = np.where(fine == OUTSIDE, behind[mixed, None], fine).mean(axis=-1)
        frame[box] = found

    def _box(self, tag: PlacedTag, half: float) -> tuple[slice, slice] | None:
        """Return rows and columns of the pixels that a tag may cover; None: none."""
        along = np.linspace(-half, half, 9)
        rim = np.array([(u, v) for w in (-half, half) for a in along for u, v in ((a, w), (w, a))])
        points = tag.place + rim @ tag.axes[:, :2].T
        if (points[:, 2] <= 1e-3).any() or tag.axes[:, 2] @ tag.place <= 0.0:  # behind the camera, or its back
            return None
        pixels = self.calibration.pixels(points)
        low = np.floor(pixels.min(axis=0)).astype(int) - 1
        high = np.ceil(pixels.max(axis=0)).astype(int) + 2
        (left, top), (right, bottom) = low.clip(0), np.minimum(high, self.calibration.image_size)
        return (slice(top, bottom), slice(left, right)) if top < bottom and left < right else None


def _cells(at: Array, cells: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return rows and columns, from 1 on, of places (..., 3) on a tag, homogeneous in cells; 0 or beyond: outside."""
    with np.errstate(all="ignore"):
        on = np.where(at[..., 2:] > 0.0, at[..., :2] / at[..., 2:], -1.0)
    column, row = np.moveaxis(np.floor(on).clip(-1, cells).astype(np.intp) + 1, -1, 0)
    return row, column
