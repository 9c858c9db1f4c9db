"""Copies of a mesh: one node of viser for all vehicles, landmarks or beads."""

from typing import Any, NamedTuple

import numpy as np

from coopenv.viz.web import shapes
from coopenv.viz.web.look import linear

_FINE_TURN = 2.0**-12


class Placed(NamedTuple):
    """Where copies are; those that are not there have size zero."""

    wxyzs: np.ndarray  # (N, 4)
    positions: np.ndarray  # (N, 3) m
    scales: np.ndarray  # (N, 3) m


def placed(rotation: np.ndarray | None, position: np.ndarray, scale: np.ndarray) -> Placed:
    """Return copies at positions (N, 3) with rotations (N, 3, 3; None: upright) and sizes (N, 3), NaN: not there."""
    good = np.isfinite(position).all(axis=1) & np.isfinite(scale).all(axis=1)
    if rotation is None:
        turned = np.tile(np.array([1.0, 0.0, 0.0, 0.0], np.float32), (len(position), 1))
    else:
        good &= np.isfinite(rotation).all(axis=(1, 2))
        turned = fine(quaternions(np.where(good[:, None, None], rotation, np.eye(3))), _FINE_TURN)
    there = good[:, None]
    return Placed(
        turned, np.where(there, position, 0.0).astype(np.float32), np.where(there, scale, 0.0).astype(np.float32)
    )


def quaternions(R: np.ndarray) -> np.ndarray:
    """Return the quaternions (N, 4), w first and not negative, of rotations (N, 3, 3)."""
    m = np.asarray(R, float)
    d = np.stack([m[:, 0, 0], m[:, 1, 1], m[:, 2, 2]], axis=-1)
    trace = d.sum(axis=-1, keepdims=True)
    squares = np.concatenate([1.0 + trace, 1.0 - trace + 2.0 * d], axis=-1)  # 4 w^2, 4 x^2, 4 y^2, 4 z^2
    w = np.stack([m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]], axis=-1)
    xy, xz, yz = (m[:, i, j] + m[:, j, i] for i, j in ((0, 1), (0, 2), (1, 2)))
    a, b, c, e = squares.T
    rows = np.stack(  # each is the quaternion times four times one of its entries; the largest entry is the safest
        [
            np.stack([a, *w.T], axis=-1),
            np.stack([w[:, 0], b, xy, xz], axis=-1),
            np.stack([w[:, 1], xy, c, yz], axis=-1),
            np.stack([w[:, 2], xz, yz, e], axis=-1),
        ],
        axis=1,
    )
    best = rows[np.arange(len(m)), np.argmax(squares, axis=-1)]
    unit = best / np.linalg.norm(best, axis=-1, keepdims=True)
    return np.asarray(np.where(unit[:, :1] < 0.0, -unit, unit))


def fine(values: np.ndarray, step: float) -> np.ndarray:
    """Return values in whole steps, in single precision: a file of them can be packed better."""
    return (np.round(np.asarray(values, float) / step) * step).astype(np.float32)


class Batch:
    """A node with copies of a mesh."""

    def __init__(self, scene: Any, name: str, mesh: shapes.Mesh, colours: np.ndarray, **look: Any) -> None:
        """Add them, one per colour (N, 3), to be placed; of none there is no node."""
        count = len(colours)
        self.handle: Any = None
        """viser's handle."""
        if count:
            self.handle = scene.add_batched_meshes_simple(
                name,
                *mesh,
                np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
                np.zeros((count, 3)),
                batched_scales=np.zeros((count, 3)),
                batched_colors=linear(colours),
                lod="off",
                **{"cast_shadow": False, "receive_shadow": False, **look},
            )

    def put(self, places: Placed, shown: bool = True) -> None:
        """Put the copies to their places."""
        if self.handle is None:
            return
        self.handle.visible = shown
        if shown:
            self.handle.batched_wxyzs = places.wxyzs
            self.handle.batched_positions = places.positions
            self.handle.batched_scales = places.scales
