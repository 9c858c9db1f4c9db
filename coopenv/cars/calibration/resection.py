"""The planar pose of a body by rays to known points, and how far rays are off."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from coopenv.estimation.poses import Array, skew

HEADINGS = 36  # that are tried; the finer ones about the best reach beyond half a step


def seen_from(unit: Array, lever: Array, point: Array) -> tuple[float, float, complex]:
    """Return misfit, heading and place of a body by rays (n, 3) from its `lever` (n, 3), m, to points (n, 3), m.

    With a heading given, the place is linear in the sightings: all headings are tried together, then finer ones.
    """
    across, (x, y, z) = skew(unit), point.T
    flat, none = across[:, :, :2], np.zeros_like(z)
    squares = np.einsum("nik,nil->nkl", flat, flat).reshape(-1, 4)
    parts = [np.stack(part, axis=-1) for part in ((x, y, none), (y, -x, none), (none, none, z))]
    parts[2] -= lever  # the three go with cosine, sine and 1
    rows = np.concatenate([np.einsum("nik,nij,nj->nk", flat, across, part) for part in parts], axis=-1)

    def fitted(headings: NDArray[Any]) -> tuple[float, float, complex]:
        turn = np.stack([np.cos(headings), np.sin(headings), np.ones(len(headings))], axis=-1)
        to = np.tensordot(turn, parts, axes=1)
        ahead, weight = to, np.ones(to.shape[:2])
        for _ in range(2):
            information = (weight @ squares).reshape(-1, 2, 2) + 1e-9 * np.eye(2)
            moments = np.einsum("hp,hpk->hk", turn, (weight @ rows).reshape(-1, 3, 2))
            shift = np.linalg.solve(information, moments[..., None])[..., 0]
            ahead = to - np.append(shift, np.zeros((len(shift), 1)), axis=1)[:, None]
            weight = 1.0 / np.maximum((ahead**2).sum(axis=-1), 0.01)
        missed = misfits(unit, ahead)
        best = int(np.argmin(missed))
        place = np.exp(1j * headings[best]) * complex(*shift[best])
        return float(missed[best]), float(headings[best]), place

    tried: NDArray[Any] = np.arange(HEADINGS) * 2 * np.pi / HEADINGS
    found = fitted(tried)
    for step in (0.02, 0.004):
        tried = found[1] + step * np.arange(-5, 6)
        found = fitted(tried)
    return found


def misfits(unit: Array, to: Array) -> Array:
    """Return means (...) of (2 sin(angle / 2))^2, up to 0.04, between unit vectors (n, 3) and vectors (..., n, 3)."""
    cosine = (to * unit).sum(axis=-1) / np.maximum(np.linalg.norm(to, axis=-1), 1e-9)
    return np.asarray(np.minimum(2.0 - 2.0 * cosine, 0.04).mean(axis=-1))
