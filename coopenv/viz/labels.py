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

    Args:
        names: M texts.
        anchors: (M, 2) pixels.
        marks: (P, 2) pixels, the points of all marks.
        lines: (Q, 2) pixels, points along lines.
        size: of the font, pt.
    """
    point = DPI / 72.0
    anchors, marks, lines = (np.asarray(a, float).reshape(-1, 2) / point for a in (anchors, marks, lines))
    taken: list[tuple[np.ndarray, np.ndarray]] = []
    offsets = []
    for name, anchor in zip(names, anchors, strict=True):
        extent = np.array([_WIDTH * len(re.sub(r"[${}_\\]", "", name)), _HEIGHT]) * size
        corners = [_corner(direction, extent) for direction in _DIRECTIONS]
        costs = [_cost(anchor + corner, extent, marks, lines, taken) for corner in corners]
        best = corners[int(np.argmin(costs))]
        taken.append((anchor + best, anchor + best + extent))
        offsets.append(best)
    return np.array(offsets).reshape(-1, 2)


def _corner(direction: tuple[int, int], extent: np.ndarray) -> np.ndarray:
    """Return the offset of the lower left corner of a text on one side of its point."""
    side = np.array(direction)
    gap = _GAP if all(direction) else 1.4 * _GAP
    return side * gap + np.where(side > 0, 0.0, np.where(side < 0, -extent, -extent / 2))


def _cost(
    low: np.ndarray,
    extent: np.ndarray,
    marks: np.ndarray,
    lines: np.ndarray,
    taken: list[tuple[np.ndarray, np.ndarray]],
) -> float:
    high = low + extent
    names = sum(bool(np.all((low < other_high) & (high > other_low))) for other_low, other_high in taken)
    on_marks = np.all((marks > low - _MARK) & (marks < high + _MARK), axis=-1).sum()
    on_lines = np.all((lines > low) & (lines < high), axis=-1).any()
    return float(_COST_OF_NAME * names + _COST_OF_MARK * on_marks + _COST_OF_LINE * on_lines)
