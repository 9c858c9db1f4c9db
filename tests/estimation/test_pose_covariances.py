"""The covariance that goes into a world's state says the same as the one that the observer states."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from coopenv.estimation.poses import Coordinates, riccati_covariance, riccati_jacobian

R_HAT = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix()
P_HAT = np.array([3.0, -2.0, 0.5])


def truth(coordinates: Coordinates, e: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The pose whose error is e by the definitions."""
    turn = Rotation.from_rotvec(e[:3]).as_matrix()
    if coordinates is Coordinates.LEFT:
        return R_HAT @ turn, P_HAT + R_HAT @ e[3:]
    return turn @ R_HAT, turn @ P_HAT + e[3:]


@pytest.mark.parametrize("coordinates", [Coordinates.LEFT, Coordinates.RIGHT])
def test_jacobian_by_differences(coordinates: Coordinates) -> None:
    h, columns = 1e-6, []
    for axis in np.eye(6):
        ends = []
        for sign in (1.0, -1.0):
            R, p = truth(coordinates, sign * h * axis)
            assert_allclose(coordinates.error(R, p, R_HAT, P_HAT), sign * h * axis, atol=1e-12)
            ends.append(Coordinates.RICCATI.error(R, p, R_HAT, P_HAT))
        columns.append((ends[0] - ends[1]) / (2 * h))
    assert_allclose(riccati_jacobian(coordinates, R_HAT, P_HAT), np.column_stack(columns), atol=1e-8)


@pytest.mark.parametrize("coordinates", list(Coordinates))
def test_small_errors_keep_their_nees(coordinates: Coordinates) -> None:
    rng = np.random.default_rng(1)
    A = rng.normal(size=(6, 6))
    P = 1e-8 * (A @ A.T + np.eye(6))
    written = riccati_covariance(coordinates, R_HAT, P_HAT, P)
    for e in rng.multivariate_normal(np.zeros(6), P, 5):
        R, p = truth(Coordinates.LEFT, e)
        own, state = (c.error(R, p, R_HAT, P_HAT) for c in (coordinates, Coordinates.RICCATI))
        assert_allclose(state @ np.linalg.solve(written, state), own @ np.linalg.solve(P, own), rtol=1e-2)
