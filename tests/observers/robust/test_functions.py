"""Functions of the embedded observer `robust` against SciPy and NumPy."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import warp as wp
from numpy.testing import assert_allclose
from scipy.linalg import eigh
from scipy.spatial.transform import Rotation

from coopenv.observers.robust.algebra import forward, inverse6, is_regular, left_error, log_so3
from coopenv.observers.robust.constants import LEAST_SHARE
from coopenv.observers.robust.correlations import excess
from coopenv.observers.robust.memory import Pose
from tests.helpers.warp_calls import Calls


@wp.func
def error_of(R: Any, p: Any, other_R: Any, other_p: Any):
    """Return the left error of another pose."""
    return left_error(Pose(R, p), Pose(other_R, other_p))


@wp.func
def transition_of(R: Any, p: Any):
    """Return the transition over an increment."""
    return forward(Pose(R, p), wp.identity(6, wp.float64))


CALLS = Calls(
    __name__,
    {},
    {
        log_so3: "33 > 3",
        error_of: "33 3 33 3 > 6",
        transition_of: "33 3 > 66",
        inverse6: "66 > 66",
        is_regular: "66 66 1 > b",
        excess: "66 66 > 66",
    },
)


def call(function: wp.Function, *inputs: Any) -> np.ndarray:
    return np.asarray(CALLS(function, "float64", *inputs))


@pytest.fixture(scope="module")
def turns() -> np.ndarray:
    """Return rotation vectors, some of them short, some nearly half a turn."""
    rng = np.random.default_rng(7)
    turns = rng.normal(size=(200, 3))
    turns *= (rng.uniform(0, np.pi, 200) / np.linalg.norm(turns, axis=1))[:, None]
    turns[:3] *= np.array([1e-12, 1e-7, 0.0])[:, None] / np.maximum(np.linalg.norm(turns[:3], axis=1), 1e-3)[:, None]
    turns[3:20] *= ((np.pi - np.geomspace(1e-9, 0.3, 17)) / np.linalg.norm(turns[3:20], axis=1))[:, None]
    return turns


def matrices(decades: float) -> np.ndarray:
    """Return symmetric matrices (200, 6, 6) with eigenvalues of so many decades to either side of 1."""
    rng = np.random.default_rng(8)
    U = np.linalg.qr(rng.normal(size=(200, 6, 6)))[0]
    return U * 10.0 ** rng.uniform(-decades, decades, (200, 1, 6)) @ np.swapaxes(U, 1, 2)


def test_rotation_vectors(turns: np.ndarray) -> None:
    found = call(log_so3, Rotation.from_rotvec(turns).as_matrix())
    assert_allclose(found, turns, rtol=0, atol=1e-9)
    assert_allclose(found[20:], turns[20:], rtol=0, atol=1e-13)


def test_left_errors(turns: np.ndarray) -> None:
    R, p = Rotation.from_rotvec(turns).as_matrix(), np.random.default_rng(9).normal(size=(200, 3))
    Rt = np.swapaxes(R, 1, 2)
    expected = np.concatenate([Rotation.from_matrix(Rt @ R[0]).as_rotvec(), np.einsum("nij,nj->ni", Rt, p[0] - p)], 1)
    assert_allclose(call(error_of, R, p, R[:1], p[:1]), expected, rtol=0, atol=1e-9)


def test_the_transition_is_the_derivative_of_the_error(turns: np.ndarray) -> None:
    """Moving a pose and its neighbour by the same odometry turns a small left error x into F x."""
    x = 1e-6 * np.random.default_rng(8).normal(size=6)
    R, p = Rotation.from_rotvec(turns[30:60]).as_matrix(), np.random.default_rng(9).normal(size=(30, 3))
    moved = Rotation.from_rotvec(x[:3]).as_matrix()
    for dR, dp, F in zip(R, p, call(transition_of, R, p), strict=True):
        theta = Rotation.from_matrix(dR.T @ moved @ dR).as_rotvec()
        rho = dR.T @ (x[3:] + moved @ dp - dp)
        assert_allclose(F @ x, np.concatenate([theta, rho]), rtol=0, atol=1e-11)


def test_inverses() -> None:
    A = matrices(4.0)
    for one, inverse in zip(A, call(inverse6, A), strict=True):
        assert_allclose(inverse @ one, np.eye(6), rtol=0, atol=1e-13 * np.linalg.cond(one))


def test_regularity_is_that_of_the_spectrum() -> None:
    A = matrices(4.0)
    spectrum = np.linalg.eigvalsh(A)
    condition = spectrum.sum(axis=1) * (1.0 / spectrum).sum(axis=1)
    regular = call(is_regular, A, call(inverse6, A), [1e6])
    clear = np.abs(np.log(condition / 1e6)) > 1e-3
    assert (regular == (condition < 1e6))[clear].all()
    assert 0 < regular.sum() < 200 and clear.sum() > 190


def test_a_sender_is_vaguer_where_what_is_told_of_it_contradicts_what_is_believed() -> None:
    """A share is left over in all directions in which both are diagonal, and no more is added."""
    rng = np.random.default_rng(0)
    A = rng.normal(size=(100, 6, 6)) * np.repeat([0.01, 0.3], 3)[:, None]  # of poses: rad and m
    after = A @ np.swapaxes(A, 1, 2) + 1e-8 * np.eye(6)
    values = rng.uniform(-1.0, 1.0, (100, 6))
    values[20:, 0] = -np.abs(values[20:, 0])
    values[:20] = rng.uniform(2.0 * LEAST_SHARE, 1.0, (20, 6))  # nothing contradicts
    B = np.linalg.cholesky(after) @ np.linalg.qr(rng.normal(size=(100, 6, 6)))[0]
    left = (B * values[:, None]) @ np.swapaxes(B, 1, 2)
    added = call(excess, left, after)
    assert (added[:20] == 0.0).all()
    assert (np.abs(added[20:]).max(axis=(1, 2)) > 0.0).all()
    for one, reported, more in zip(left, after, added, strict=True):
        before, axes = eigh(one, reported)
        now = axes.T @ (one + more) @ axes
        assert_allclose(now, np.diag(np.maximum(before, LEAST_SHARE)), atol=1e-9)
