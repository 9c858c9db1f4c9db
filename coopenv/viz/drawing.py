"""Axes on which paths, marks and names are drawn, in plan or in space, cut off at a box."""

from typing import Any

import numpy as np
from mpl_toolkits.mplot3d import proj3d

from coopenv.viz import style
from coopenv.viz.clipping import clipped
from coopenv.viz.labels import place_names

_NAME = style.NORMAL + 1  # pt


class Drawing:
    """Axes with what has been drawn on them, names to be placed at the end."""

    def __init__(self, ax: Any, low: np.ndarray, high: np.ndarray, dimensions: int) -> None:
        self.ax, self.low, self.high, self.dimensions = ax, low, high, dimensions
        self.outside = False  # an estimate starts outside the box
        self._marks: list[np.ndarray] = []
        self._lines: list[np.ndarray] = []
        self._names: list[tuple[str, np.ndarray, str]] = []

    def line(self, path: np.ndarray, **look: Any) -> None:
        """Draw what lies in the box of a path (K, 3)."""
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
