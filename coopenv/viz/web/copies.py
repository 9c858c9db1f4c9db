"""Copies of a mesh: one node of viser for all vehicles, landmarks or beads."""

from typing import Any, NamedTuple

import numpy as np

from coopenv.viz.web import shapes
from coopenv.viz.web.look import linear
from coopenv.viz.web.sent import Sent

_FINE_TURN = 2.0**-11


class Placed(NamedTuple):
    """Where copies are; those that are not there have size zero."""

    wxyzs: np.ndarray  # (N, 4)
    positions: np.ndarray  # (N, 3) m
    scales: np.ndarray  # (N, 3) m


def placed(rotation: np.ndarray | None, position: np.ndarray, scale: np.ndarray, turn: float = _FINE_TURN) -> Placed:
    """Return copies at positions (N, 3) with rotations (N, 3, 3; None: upright) and sizes (N, 3), NaN: not there.

    Quaternions are given in steps of `turn`.
    """
    good = np.isfinite(position).all(axis=1) & np.isfinite(scale).all(axis=1)
    if rotation is None:
        turned = np.tile(np.array([1.0, 0.0, 0.0, 0.0], np.float32), (len(position), 1))
    else:
        good &= np.isfinite(rotation).all(axis=(1, 2))
        turned = fine(quaternions(np.where(good[:, None, None], rotation, np.eye(3))), turn)
    there = good[:, None]
    return Placed(
        turned, np.where(there, position, 0.0).astype(np.float32), np.where(there, scale, 0.0).astype(np.float32)
    )


def quaternions(R: np.ndarray) -> np.ndarray:
    """Return the quaternions (N, 4), w first and not negative, of rotations (N, 3, 3)."""
    m = np.asarray(R, float)
    x, y, z = m[:, 0, 0], m[:, 1, 1], m[:, 2, 2]
    rows = np.empty((len(m), 4, 4))  # each is the quaternion times four times one of its entries
    rows[:, 0, 0], rows[:, 1, 1] = 1.0 + x + y + z, 1.0 + x - y - z
    rows[:, 2, 2], rows[:, 3, 3] = 1.0 - x + y - z, 1.0 - x - y + z
    for entry, (i, j) in enumerate(((2, 1), (0, 2), (1, 0)), start=1):
        rows[:, 0, entry] = rows[:, entry, 0] = m[:, i, j] - m[:, j, i]
        first, second = 1 + min(i, j), 1 + max(i, j)
        rows[:, first, second] = rows[:, second, first] = m[:, i, j] + m[:, j, i]
    squares = np.einsum("nii->ni", rows)
    best = rows[np.arange(len(m)), np.argmax(squares, axis=-1)]  # the largest entry is the safest
    unit = best / np.sqrt(np.einsum("ni,ni->n", best, best))[:, None]
    return np.asarray(np.where(unit[:, :1] < 0.0, -unit, unit))


def fine(values: np.ndarray, step: float) -> np.ndarray:
    """Return values in whole steps, in single precision: a file of them can be packed better."""
    return (np.round(np.asarray(values, float) / step) * step).astype(np.float32)


class Batch:
    """A node with copies of a mesh."""

    def __init__(self, scene: Any, name: str, mesh: shapes.Mesh, colours: np.ndarray, **look: Any) -> None:
        """Add them, one per colour (N, 3), to be placed; of none there is no node."""
        count = len(colours)
        self._node: Sent | None = None
        if count:
            handle = scene.add_batched_meshes_simple(
                name,
                *mesh,
                np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
                np.zeros((count, 3)),
                batched_scales=np.zeros((count, 3)),
                batched_colors=linear(colours),
                lod="off",
                **{"cast_shadow": False, "receive_shadow": False, **look},
            )
            self._node = Sent(handle)

    @property
    def handle(self) -> Any:
        """Viser's handle; None: there is no node."""
        return None if self._node is None else self._node.handle

    def put(self, places: Placed, shown: bool = True) -> None:
        """Put the copies to their places."""
        if self._node is None:
            return
        self._node.tell(visible=shown)
        if shown:
            wxyzs, positions, scales = places
            self._node.tell(batched_wxyzs=wxyzs, batched_positions=positions, batched_scales=scales)
