"""SE(3) against matrix exponentials, covariances between error coordinates, and LAPACK called directly."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from coopenv.estimation.poses import (
    Coordinates,
    adjoint,
    cholesky,
    exp_se3,
    riccati_covariance,
    riccati_jacobian,
    rigid_exp,
    solve,
)


def hat(xi: np.ndarray) -> np.ndarray:
    x, y, z = xi[:3]
    T = np.zeros((4, 4))
    T[:3, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
    T[:3, 3] = xi[3:]
    return T


def motion(xi: np.ndarray) -> np.ndarray:
    R, p = exp_se3(xi)
    return np.block([[R, p[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 0.0099, 0.0101, 1.0, 3.1, 7.0])
def test_exponential_is_that_of_the_matrix(angle: float) -> None:
    rng = np.random.default_rng(0)
    axis = rng.normal(size=3)
    xi = np.concatenate([angle * axis / np.linalg.norm(axis), rng.normal(size=3)])
    assert_allclose(motion(xi), expm(hat(xi)), atol=1e-13)


def test_exponential_of_many_is_that_of_each() -> None:
    xi = np.random.default_rng(1).normal(size=(2, 5, 6)) * np.logspace(-6, 0, 5)[:, None]
    R, p = exp_se3(xi)
    for i, j in np.ndindex(2, 5):
        single = exp_se3(xi[i, j])
        assert_allclose(R[i, j], single[0], atol=1e-13)
        assert_allclose(p[i, j], single[1], atol=1e-13)


def test_adjoint_carries_a_motion_to_the_other_side() -> None:
    rng = np.random.default_rng(2)
    T, xi = motion(rng.normal(size=6)), rng.normal(size=6)
    assert_allclose(motion(adjoint(T[:3, :3], T[:3, 3]) @ xi), T @ motion(xi) @ np.linalg.inv(T), atol=1e-12)


@given(st.lists(st.floats(-3.0, 3.0), min_size=6, max_size=6), st.sampled_from([1.0, 1e-3, 1e-5, 0.0]))
def test_one_pair_alone_is_the_same(values: list[float], scale: float) -> None:
    xi = np.array(values) * scale
    for one, many in zip(rigid_exp(xi[:3], xi[3:]), exp_se3(xi), strict=True):
        np.testing.assert_allclose(one, many, atol=1e-9)


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
