"""SE(3) against matrix exponentials and products of 4x4 matrices."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.linalg import expm

from coopenv.estimation.poses import adjoint, exp_se3, rigid_exp


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
