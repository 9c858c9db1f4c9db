"""Rotations of messages."""

import math
from typing import Any

import numpy as np

from coopenv.errors import CoopenvError
from coopenv.svea.samples import Array

UNIT = 1e-3
"""How far from 1 a quaternion's length may be: single precision and rounded decimals are nearer."""


def rotation_of(quaternion: Any, field: str) -> Array:
    """Return the rotation matrix (3, 3) of a message's quaternion. Raises CoopenvError: its length is not 1."""
    w, x, y, z = _unit(quaternion, field)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def rotation_vector_of(quaternion: Any, field: str) -> Array:
    """Return the rotation vector (3,) of a message's quaternion, rad; errors as for `rotation_of`."""
    w, x, y, z = _unit(quaternion, field)
    if w < 0.0:  # the shorter way round
        w, x, y, z = -w, -x, -y, -z
    sine = math.sqrt(x * x + y * y + z * z)
    factor = 2.0 if sine < 1e-12 else 2.0 * math.atan2(sine, w) / sine
    return factor * np.array([x, y, z])


def _unit(quaternion: Any, field: str) -> tuple[float, float, float, float]:
    w, x, y, z = (float(getattr(quaternion, part)) for part in "wxyz")
    length = math.sqrt(w * w + x * x + y * y + z * z)
    if not abs(length - 1.0) <= UNIT:
        raise CoopenvError(f"{field}: no unit quaternion, its length is {length:.6g}")
    return w / length, x / length, y / length, z / length
