"""Frames of a camera that looks at tags, by casting rays."""

from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coopenv.cars.readings import Calibration, rays
from coopenv.cars.vision import dictionary_of, opencv
from coopenv.estimation.lens import distort
from coopenv.estimation.poses import Array

SAMPLES = 4
"""Rays along a side of a pixel."""

WHITE, BLACK, WALL = 220.0, 30.0, 120.0
"""Shades of tags, and of what is behind them."""


class PlacedTag(NamedTuple):
    """A tag in front of a camera."""

    number: int
    axes: Array  # (3, 3) columns: to its right, downwards and behind it, as its reader sees it; optical frame
    place: Array  # (3,) of its centre, optical frame, m
    side: float  # of its black square, m; a white border of one cell is around it


@cache
def pattern(family: str, number: int) -> Array:
    """Return the shades of the cells of a tag, border included."""
    dictionary = dictionary_of(family)
    cells = opencv().aruco.generateImageMarker(dictionary, number, dictionary.markerSize + 2)
    return np.where(np.pad(cells, 1, constant_values=255) > 127, WHITE, BLACK)


@cache
def pixel_rays(calibration: Calibration) -> tuple[Array, Array, Array]:
    """Return the rays (height, width, 3) of all pixels, at depth 1, and their changes down and right."""
    width, height = calibration.image_size
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 2)
    units, there = rays(pixels.astype(np.float64), calibration)
    units[~there] = np.nan  # meets no tag
    found = (units / units[:, 2:]).reshape(height, width, 3)
    return found, *np.gradient(found)[:2]  # per pixel: nearly the same all over it


class FrameRenderer:
    """Renders frames of one camera; pixels have whole numbers in their middle, as in OpenCV."""

    def __init__(self, calibration: Calibration, family: str) -> None:
        self.calibration, self.family = calibration, family
        self._rays, self._down, self._right = pixel_rays(calibration)

    def render(
        self, tags: Sequence[PlacedTag], *, blur: float = 0.0, noise: float = 0.0, seed: int = 0
    ) -> NDArray[np.uint8]:
        """Return a frame (height, width); blur is in pixels, noise in shades, standard deviations both."""
        width, height = self.calibration.image_size
        frame: NDArray[Any] = np.full((height, width), WALL, np.float32)
        for tag in sorted(tags, key=lambda tag: -float(np.linalg.norm(tag.place))):
            self._paint(frame, tag)
        if blur:
            frame = opencv().GaussianBlur(frame, (0, 0), blur)
        if noise:
            frame = frame + np.random.default_rng(seed).normal(0.0, noise, frame.shape)
        return np.asarray(np.rint(frame).clip(0, 255), dtype=np.uint8)

    def _paint(self, frame: NDArray[Any], tag: PlacedTag) -> None:
        shades = pattern(self.family, tag.number)
        cells, cell = len(shades), tag.side / (len(shades) - 2)
        box = self._box(tag, 0.5 * cells * cell)
        if box is None:
            return
        inner = (np.arange(SAMPLES) + 0.5) / SAMPLES - 0.5
        down = inner[:, None, None, None] * self._down[box][:, None, :, None]
        right = inner[:, None] * self._right[box][:, None, :, None]
        seen = self._rays[box][:, None, :, None] + down + right
        normal = tag.axes[:, 2]
        with np.errstate(all="ignore"):
            far = (normal @ tag.place) / (seen @ normal)
            on = (seen * far[..., None] - tag.place) @ tag.axes[:, :2] / cell + 0.5 * cells
        hit = (far > 0.0) & ((on >= 0.0) & (on < cells)).all(axis=-1)
        column, row = np.moveaxis(np.where(hit[..., None], on, 0.0).astype(np.intp), -1, 0)
        part = frame[box]
        shown = np.where(hit, shades[row, column], part[:, None, :, None])
        frame[box] = shown.mean(axis=(1, 3))

    def _box(self, tag: PlacedTag, half: float) -> tuple[slice, slice] | None:
        """Return rows and columns of the pixels that a tag may cover; None: none."""
        along = np.linspace(-half, half, 9)
        rim = np.array([(u, v) for w in (-half, half) for a in along for u, v in ((a, w), (w, a))])
        points = tag.place + rim @ tag.axes[:, :2].T
        if (points[:, 2] <= 1e-3).any() or tag.axes[:, 2] @ tag.place <= 0.0:  # behind the camera, or its back
            return None
        c = self.calibration
        pixels = distort(points[:, :2] / points[:, 2:], c.distortion) * c.focal_length + np.array(c.principal_point)
        low = np.floor(pixels.min(axis=0)).astype(int) - 1
        high = np.ceil(pixels.max(axis=0)).astype(int) + 2
        (left, top), (right, bottom) = low.clip(0), np.minimum(high, c.image_size)
        return (slice(top, bottom), slice(left, right)) if top < bottom and left < right else None
