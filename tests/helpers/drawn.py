"""Contents of a figure, read back: bars, lines and words."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D


def spans(ax: Axes, colour: str) -> list[tuple[float, float]]:
    """Return (start, end) of the horizontal bars of one face colour, in order."""
    found: list[tuple[float, float]] = []
    for collection in ax.collections:
        faces = collection.get_facecolor()
        if isinstance(collection, PolyCollection) and np.array_equal(faces, mpl.colors.to_rgba_array(colour)):
            x = [np.asarray(path.vertices)[:, 0] for path in collection.get_paths()]
            found += [(values.min(), values.max()) for values in x]
    return sorted(found)


def xdata(line: Line2D) -> np.ndarray:
    return np.asarray(line.get_xdata(), float)


def ydata(line: Line2D) -> np.ndarray:
    return np.asarray(line.get_ydata(), float)


def texts(figure: Figure) -> set[str]:
    return {text.get_text() for text in figure.findobj(mpl.text.Text) if text.get_text()}
