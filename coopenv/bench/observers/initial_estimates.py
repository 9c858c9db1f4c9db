"""Other initial estimates on the same record: what a study of the basin of attraction varies."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from coopenv.bench.observers.faults import changed
from coopenv.estimation.arrays import Array
from coopenv.observers.recording import Recording

UNIFORM_ANGLE_VARIANCE = (np.pi**2 / 3.0 + 2.0) / 3.0
"""rad^2, per axis of the rotation vector of a rotation uniform over SO(3)."""


def with_start(recording: Recording, rotations: Array, positions: Array, covariance: ArrayLike) -> Recording:
    """Return the record with other initial estimates.

    Args:
        recording: of N vehicles.
        rotations: (N, 3, 3) body to map.
        positions: (N, 3) map, m.
        covariance: (6, 6) for all or (N, 6, 6), in LEFT coordinates, rad and m.
    """
    N = len(recording.setups)
    return changed(
        recording,
        start_rotation=np.array(rotations, float),
        start_position=np.array(positions, float),
        start_covariance=np.array(np.broadcast_to(np.asarray(covariance, float), (N, 6, 6))),
    )


def random_start(recording: Recording, seed: int, radius: float = 15.0) -> Recording:
    """Return the record with attitudes uniform over SO(3) and positions uniform in a ball about the true ones.

    The covariance is that of these distributions: (pi^2 / 3 + 2) / 3 rad^2 and radius^2 / 5 per axis.

    Args:
        recording: of N vehicles; each gets a draw of its own.
        seed: of the draw.
        radius: of the ball, m.
    """
    generator = np.random.default_rng([seed, 3])
    N = len(recording.setups)
    direction = generator.normal(size=(N, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    distance = radius * generator.random((N, 1)) ** (1 / 3)
    return with_start(
        recording,
        np.asarray(Rotation.random(N, generator).as_matrix()),
        recording.truth.position[0] + distance * direction,
        np.diag(np.repeat([UNIFORM_ANGLE_VARIANCE, radius**2 / 5.0], 3)),
    )
