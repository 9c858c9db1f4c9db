"""Where the names of things go, so that they cover neither marks nor each other."""

import re
from collections.abc import Sequence

import numpy as np

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
    """Return what a name that covers a box would cost; `taken` are corners (2, 2) of the boxes of others."""
    high = low + extent
    names = sum(bool(np.all((low < other[1]) & (high > other[0]))) for other in taken)
    on_marks = np.all((marks > low - _MARK) & (marks < high + _MARK), axis=-1).sum()
    on_lines = np.all((lines > low) & (lines < high), axis=-1).any()
    return float(_COST_OF_NAME * names + _COST_OF_MARK * on_marks + _COST_OF_LINE * on_lines)
