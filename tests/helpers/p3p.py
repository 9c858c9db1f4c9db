"""The perspective solver for a single triple."""

import numpy as np

from coopenv.observers.robust.p3p import solve_p3p


def solve_one(bearings: np.ndarray, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rotations (n, 3, 3) and camera positions (n, 3), n = 0..4, for bearings and positions (3, 3)."""
    R, c, mask = solve_p3p(np.asarray(bearings)[None], np.asarray(positions)[None])
    return R[0, mask[0]], c[0, mask[0]]
