"""Artists that are kept and updated, drawn over a background that is drawn once."""

from typing import Any, cast

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D


class Layers:
    """The moving artists of a figure, from below to above in the order in which they are added."""

    def __init__(self, figure: Figure, axes: Axes) -> None:
        self._figure, self._axes = figure, axes
        self._canvas = cast(FigureCanvasAgg, figure.canvas)
        self._artists: list[Artist] = []
        self._background: Any = None

    def polygons(self, **look: Any) -> Any:
        """Add a collection of polygons, in axes coordinates."""
        return self.keep(self._axes.add_collection(PolyCollection([], **look), autolim=False))

    def lines(self, **look: Any) -> Any:
        """Add a collection of lines, in axes coordinates."""
        return self.keep(self._axes.add_collection(LineCollection([], **look), autolim=False))

    def points(self, marker: str, face: str, edge: str, size: float) -> Any:
        """Add points, in axes coordinates; `size` in pt."""
        line = Line2D([], [], linestyle="none", marker=marker, markersize=size, markeredgewidth=0.9)
        line.set(markerfacecolor=face, markeredgecolor=edge)
        return self.keep(self._axes.add_line(line))

    def keep(self, artist: Any) -> Any:
        """Add an artist that is already in the figure."""
        artist.set_animated(True)
        self._artists.append(artist)
        return artist

    def paint(self) -> np.ndarray:
        """Return the picture, (H, W, 3) uint8; what is no layer must not have changed since the first one."""
        if self._background is None:
            self._canvas.draw()
            self._background = self._canvas.copy_from_bbox(self._figure.bbox)
        self._canvas.restore_region(self._background)
        renderer = self._canvas.get_renderer()
        for artist in self._artists:
            artist.draw(renderer)
        return np.asarray(self._canvas.buffer_rgba())[..., :3].copy()
