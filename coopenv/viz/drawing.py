"""Axes on which paths, marks and names are drawn, in plan or in space, cut off at a box."""

import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.colors import to_rgb
from mpl_toolkits.mplot3d import proj3d

from coopenv.viz import style
from coopenv.viz.style import DPI

_GAP = 5.0  # pt between a point and its name
_MARK = 4.5  # pt, half the side of a mark
_WIDTH, _HEIGHT = 0.62, 0.95  # of a character, in font sizes
_DIRECTIONS = ((1, 1), (1, -1), (-1, 1), (-1, -1), (1, 0), (-1, 0), (0, 1), (0, -1))
_COST_OF_NAME, _COST_OF_MARK, _COST_OF_LINE = 200.0, 100.0, 1.0


def place_names(
    names: Sequence[str], anchors: np.ndarray, marks: np.ndarray, lines: np.ndarray, size: float
) -> np.ndarray:
    """Return the offsets (M, 2), in pt, of names' lower left corners from their points.

    Each name in turn takes the side of its point that covers the least: first other names, then marks, then lines.
    Points of names (M, 2), of all marks (P, 2) and along lines (Q, 2) are in pixels; the font's size is in pt.
    """
    point = DPI / 72.0
    anchors, marks, lines = (np.asarray(a, float).reshape(-1, 2) / point for a in (anchors, marks, lines))
    taken: list[np.ndarray] = []
    offsets = []
    for name, anchor in zip(names, anchors, strict=True):
        extent = np.array([_WIDTH * len(re.sub(r"[${}_\\]", "", name)), _HEIGHT]) * size
        corners = [_corner(direction, extent) for direction in _DIRECTIONS]
        costs = [_cost(anchor + corner, extent, marks, lines, taken) for corner in corners]
        best = corners[int(np.argmin(costs))]
        taken.append(np.stack([anchor + best, anchor + best + extent]))
        offsets.append(best)
    return np.array(offsets).reshape(-1, 2)


def _corner(direction: tuple[int, int], extent: np.ndarray) -> np.ndarray:
    """Return the offset of the lower left corner of a text on one side of its point."""
    side = np.array(direction)
    gap = _GAP if all(direction) else 1.4 * _GAP
    return side * gap + np.where(side > 0, 0.0, np.where(side < 0, -extent, -extent / 2))


def _cost(low: np.ndarray, extent: np.ndarray, marks: np.ndarray, lines: np.ndarray, taken: list[np.ndarray]) -> float:
    """Return the cost of a name that covers a box; `taken` are corners (2, 2) of the boxes of other names."""
    high = low + extent
    names = sum(bool(np.all((low < other[1]) & (high > other[0]))) for other in taken)
    on_marks = np.all((marks > low - _MARK) & (marks < high + _MARK), axis=-1).sum()
    on_lines = np.all((lines > low) & (lines < high), axis=-1).any()
    return float(_COST_OF_NAME * names + _COST_OF_MARK * on_marks + _COST_OF_LINE * on_lines)


def clipped(path: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the parts (M, D) of a line (K, D) within a box, apart by rows of NaN, each cut where it meets a side."""
    path = np.asarray(path, float)
    if len(path) == 1:
        return path if np.all((path >= low) & (path <= high)) else np.empty((0, path.shape[1]))
    start = path[:-1]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        step = np.diff(path, axis=0)
        to_low, to_high = (low - start) / step, (high - start) / step
        still = step == 0
        within = (start >= low) & (start <= high)
        enter = np.where(still, np.where(within, -np.inf, np.inf), np.minimum(to_low, to_high)).max(axis=1)
        leave = np.where(still, np.inf, np.maximum(to_low, to_high)).min(axis=1)
        enter, leave = np.maximum(enter, 0.0), np.minimum(leave, 1.0)
        drawn = enter <= leave  # False for NaN
    points: list[np.ndarray] = []
    gap = np.full(path.shape[1], np.nan)
    connected = False
    for i in np.flatnonzero(drawn):
        connected = connected and bool(drawn[i - 1]) and enter[i] == 0.0
        if not connected:
            points += [gap] if points else []
            points.append(start[i] + enter[i] * step[i] if enter[i] > 0 else start[i])
        points.append(path[i + 1] if leave[i] == 1.0 else start[i] + leave[i] * step[i])
        connected = bool(leave[i] == 1.0)
    return np.array(points).reshape(-1, path.shape[1])


_NAME = style.NORMAL + 1  # pt


class Drawing:
    """Axes with lines, marks, and names that are placed at the end."""

    def __init__(self, ax: Any, low: np.ndarray, high: np.ndarray, dimensions: int) -> None:
        self.ax, self.low, self.high, self.dimensions = ax, low, high, dimensions
        self.outside = False  # an estimate starts outside the box
        self._marks: list[np.ndarray] = []
        self._lines: list[np.ndarray] = []
        self._names: list[tuple[str, np.ndarray, str]] = []

    def line(self, path: np.ndarray, **look: Any) -> None:
        """Draw the part of a path (K, 3) that lies in the box."""
        used = slice(self.dimensions)
        shown = clipped(path[:, used], self.low[used], self.high[used])
        self.ax.plot(*shown.T, **look)
        self._lines.append(shown)

    def mark(self, point: np.ndarray, marker: str, edge: str, face: str | None = None) -> None:
        """Mark a point (3,); the face has the colour of the edge unless another one is given."""
        point = point[: self.dimensions]
        self.ax.plot(*point[:, None], clip_on=False, zorder=4, **marker_look(marker, edge, face or edge))
        self._marks.append(point)

    def stem(self, point: np.ndarray, **look: Any) -> None:
        """Connect a point (3,) with the floor of the box, in space."""
        if self.dimensions == 3:
            foot = np.array([*point[:2], self.low[2]])
            self.line(np.stack([foot, point]), **look)

    def name(self, point: np.ndarray, text: str, colour: str) -> None:
        """Name a point (3,)."""
        self._names.append((text, point[: self.dimensions], colour))

    def write_names(self) -> None:
        """Write the names; the limits of the axes must be final."""
        self.ax.apply_aspect()
        if not self._names:
            return
        texts, points, colours = zip(*self._names, strict=True)
        anchors = self._plane(np.array(points))
        marks, lines = self._plane(np.array(self._marks)), self._plane(np.concatenate(self._lines or [points]))
        pixels = self.ax.transData.transform
        offsets = place_names(texts, pixels(anchors), pixels(marks), pixels(lines), _NAME)
        look: dict[str, Any] = {"fontsize": _NAME, "path_effects": style.HALO, "zorder": 5}
        for text, anchor, offset, colour in zip(texts, anchors, offsets, colours, strict=True):
            self.ax.annotate(text, anchor, offset, textcoords="offset points", color=colour, **look)

    def _plane(self, points: np.ndarray) -> np.ndarray:
        """Return points (K, D) in the coordinates of the plane that is drawn."""
        if self.dimensions == 2:
            return points
        x, y, _ = proj3d.proj_transform(*points.T, self.ax.get_proj())
        return np.stack([x, y], axis=-1)


def marker_look(marker: str, edge: str, face: str) -> dict[str, Any]:
    """Return how a mark of a point looks."""
    look = {"marker": marker, "markeredgecolor": edge, "markerfacecolor": face}
    return {"linestyle": "none", "markersize": 6.0, "markeredgewidth": 1.0, **look}


Colour = str | tuple[float, float, float]
LEAST = 4.5
"""Of text, as WCAG 2 asks for at level AA."""


def linear_light(part: np.ndarray) -> np.ndarray:
    """Return the linear intensities of sRGB components, both 0 to 1."""
    return np.where(part <= 0.04045, part / 12.92, ((part + 0.055) / 1.055) ** 2.4)


def luminance(colour: Colour) -> float:
    """Return the relative luminance of a colour, 0 (black) to 1 (white)."""
    return float(linear_light(np.array(to_rgb(colour))) @ (0.2126, 0.7152, 0.0722))


def contrast(colour: Colour, background: Colour = "white") -> float:
    """Return the contrast of two colours, 1 (none) to 21 (black on white)."""
    low, high = sorted((luminance(colour), luminance(background)))
    return (high + 0.05) / (low + 0.05)
