"""Oriented boxes, many at once: which of them overlap."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

BLOCK = 200_000
"""Pairs that are compared at a time; each takes some 400 bytes."""


class Boxes(NamedTuple):
    """n boxes; a half size of zero makes a point."""

    center: NDArray[np.float64]
    """(n, 3) m"""
    rotation: NDArray[np.float64]
    """(n, 3, 3)"""
    half: NDArray[np.float64]
    """(n, 3) half of the edges, m"""


def boxes_overlap(a: Boxes, b: Boxes) -> NDArray[np.bool_]:
    """Return (n,) which boxes of `a` overlap those of `b` at the same place (separating axis theorem).

    Source: Gottschalk, Lin, Manocha, OBBTree, SIGGRAPH 1996.
    """
    A, B = np.swapaxes(a.rotation, 1, 2), np.swapaxes(b.rotation, 1, 2)
    edges = np.cross(A[:, :, None], B[:, None, :]).reshape(-1, 9, 3)
    axes = np.concatenate([A, B, edges], axis=1)
    reach = (np.abs(axes @ a.rotation) @ a.half[..., None] + np.abs(axes @ b.rotation) @ b.half[..., None])[..., 0]
    apart = np.abs(axes @ (b.center - a.center)[..., None])[..., 0] >= reach
    parallel = np.linalg.norm(axes, axis=-1) <= 1e-9  # edges without a plane between them
    return np.asarray(~(apart & ~parallel).any(axis=1))


def overlapping_pairs(a: Boxes, b: Boxes) -> NDArray[np.int64]:
    """Return the indices (k, 2) of all boxes of `a` and `b` that overlap, in the order of `a`.

    If `b` is `a` itself, each pair of different boxes counts once, the larger index first.
    """
    radius_a, radius_b = np.linalg.norm(a.half, axis=1), np.linalg.norm(b.half, axis=1)
    rows = max(1, BLOCK // max(1, len(b.half)))
    found = [np.empty((0, 2), np.int64)]
    for first in range(0, len(a.half), rows):
        part = slice(first, first + rows)
        distance = np.linalg.norm(a.center[part, None] - b.center, axis=-1)
        near = distance <= radius_a[part, None] + radius_b
        i, j = np.nonzero(np.tril(near, first - 1) if b is a else near)
        i += first
        overlap = boxes_overlap(Boxes(*(x[i] for x in a)), Boxes(*(x[j] for x in b)))
        found.append(np.column_stack([i[overlap], j[overlap]]))
    return np.concatenate(found)
