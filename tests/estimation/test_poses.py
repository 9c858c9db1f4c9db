"""SE(3) against matrix exponentials, covariances between error coordinates, LAPACK called directly, and validity."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from coopenv.estimation.poses import (
    Coordinates,
    adjoint,
    are_covariances,
    are_numbers,
    are_rotations,
    are_unit_vectors,
    cholesky,
    exp_so3,
    exp_translation,
    riccati_covariance,
    solve,
)


def hat(xi: np.ndarray) -> np.ndarray:
    x, y, z = xi[:3]
    T = np.zeros((4, 4))
    T[:3, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
    T[:3, 3] = xi[3:]
    return T


def motion(xi: np.ndarray) -> np.ndarray:
    R, p = exp_so3(xi[:3]), exp_translation(xi[:3], xi[3:])
    return np.block([[R, p[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 0.0099, 0.0101, 1.0, 3.1, 7.0])
def test_exponential_is_that_of_the_matrix(angle: float) -> None:
    rng = np.random.default_rng(0)
    axis = rng.normal(size=3)
    xi = np.concatenate([angle * axis / np.linalg.norm(axis), rng.normal(size=3)])
    assert_allclose(motion(xi), expm(hat(xi)), atol=1e-13)


def test_adjoint_carries_a_motion_to_the_other_side() -> None:
    rng = np.random.default_rng(2)
    T, xi = motion(rng.normal(size=6)), rng.normal(size=6)
    assert_allclose(motion(adjoint(T[:3, :3], T[:3, 3]) @ xi), T @ motion(xi) @ np.linalg.inv(T), atol=1e-12)


R_HAT = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix()
P_HAT = np.array([3.0, -2.0, 0.5])


@pytest.mark.parametrize("coordinates", list(Coordinates))
def test_small_errors_keep_their_nees(coordinates: Coordinates) -> None:
    rng = np.random.default_rng(1)
    A = rng.normal(size=(6, 6))
    P = 1e-8 * (A @ A.T + np.eye(6))
    written = riccati_covariance(coordinates, R_HAT, P_HAT, P)
    for e in rng.multivariate_normal(np.zeros(6), P, 5):
        R, p = R_HAT @ Rotation.from_rotvec(e[:3]).as_matrix(), P_HAT + R_HAT @ e[3:]
        own, state = (c.error(R, p, R_HAT, P_HAT) for c in (coordinates, Coordinates.RICCATI))
        assert_allclose(state @ np.linalg.solve(written, state), own @ np.linalg.solve(P, own), rtol=1e-2)


@pytest.mark.parametrize("n", [1, 2, 6, 24])
def test_factor_and_solutions(n: int) -> None:
    rng = np.random.default_rng(n)
    B, b = rng.normal(size=(n, n)), rng.normal(size=(n, 3))
    A = B @ B.T + 0.1 * np.eye(n)
    assert_allclose(solve(B, b), np.linalg.solve(B, b), rtol=1e-9, atol=1e-9)
    assert_allclose(cholesky(A), np.linalg.cholesky(A), rtol=1e-9, atol=1e-12)


def test_arguments_stay_as_they_are() -> None:
    A, b = np.array([[4.0, 1.0], [1.0, 3.0]]), np.array([1.0, 2.0])
    for argument in (A, b):
        argument.setflags(write=False)
    solve(A, b)
    cholesky(A)
    assert_allclose(A, [[4.0, 1.0], [1.0, 3.0]])
    assert_allclose(b, [1.0, 2.0])


def test_what_has_no_answer_is_refused() -> None:
    with pytest.raises(np.linalg.LinAlgError):
        cholesky(np.diag([1.0, -1.0]))
    with pytest.raises(np.linalg.LinAlgError):
        solve(np.ones((2, 2)), np.ones(2))


ROTATIONS = Rotation.random(200, random_state=0).as_matrix()


def test_numbers() -> None:
    assert are_numbers(np.array([0.0, -1e9, 5e-324, 1.1e9, np.nan, np.inf, -np.inf])).tolist() == [1, 1, 1, 0, 0, 0, 0]


def test_unit_vectors() -> None:
    vectors = ROTATIONS[:, 0]
    assert are_unit_vectors(vectors).all()
    for wrong in (0.0 * vectors, 1.001 * vectors, np.nan * vectors, 1e300 * vectors, vectors + np.inf):
        assert not are_unit_vectors(wrong).any()


def test_rotations() -> None:
    assert are_rotations(ROTATIONS).all()
    assert are_rotations(ROTATIONS.astype(np.float32), 1e-5).all()
    for wrong in (0.0, 1.001, -1.0, np.nan, 1e300):
        assert not are_rotations(wrong * ROTATIONS).any()
    assert not are_rotations(ROTATIONS * [1.0, -1.0, 1.0]).any()  # reflections
    assert not are_rotations(ROTATIONS + 1e-3 * np.tri(3)).any()
    assert are_rotations(np.stack([np.eye(3), np.full((3, 3), np.inf)])).tolist() == [True, False]


def test_covariances_of_very_different_variances() -> None:
    L = np.random.default_rng(0).normal(size=(200, 6, 6))
    P = L @ np.swapaxes(L, -1, -2)
    scale = np.diag([1e-6, 1.0, 1e-3, 1e6, 1e3, 1.0])
    P = scale @ P @ scale
    P = (P + np.swapaxes(P, -1, -2)) / 2
    assert are_covariances(P, 1e-12).all()
    flat = P.copy()
    flat[:, 2], flat[:, :, 2] = 0.0, 0.0
    assert not are_covariances(flat, 1e-12).any() and are_covariances(flat, -1e-9).all()
    lopsided = P.copy()
    lopsided[:, 0, 1] *= 1.1
    for wrong in (-P, np.nan * P, 1e200 * P, lopsided, np.zeros((2, 6, 6)), np.ones((2, 6, 6))):
        assert not are_covariances(wrong, 1e-12).any()
    mixed = np.stack([P[0], -P[1], P[2]])
    assert are_covariances(mixed, 1e-12).tolist() == [True, False, True]
