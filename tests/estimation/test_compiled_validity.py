"""Compiled checks of arrays against NumPy: a single strange entry is found wherever it stands."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from coopenv.estimation.compiled_validity import is_covariance, is_plain, is_position, is_rotation

STRANGE = [np.nan, np.inf, -np.inf, 1e200, -1e200]
R = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
ROOT = np.random.default_rng(0).normal(size=(6, 6))
P = ROOT @ ROOT.T + np.eye(6)


@pytest.mark.parametrize("value", STRANGE)
def test_a_strange_entry_anywhere(value: float) -> None:
    for k in range(3):
        p = np.zeros(3)
        p[k] = value
        assert not is_position(p, 1e8)
    for i, j in product(range(3), range(3)):
        bent = R.copy()
        bent[i, j] = value
        assert not is_rotation(bent)
    for i, j in product(range(6), range(6)):
        lopsided = P.copy()
        lopsided[i, j] = value
        assert not is_covariance(lopsided, 0.0, 1e12)
        lopsided[j, i] = value
        assert not is_covariance(lopsided, 0.0, 1e12)


def test_what_is_valid() -> None:
    assert is_position(np.array([1.0, -2.0, 3.0]), 3.0) and not is_position(np.array([1.0, -2.0, 3.1]), 3.0)
    assert is_rotation(R) and not is_rotation(-R) and not is_rotation(R * (1.0 + 1e-5))
    assert is_covariance(P, 0.0, 1e3) and not is_covariance(P, 1e3, 1e12) and not is_covariance(P, 0.0, 1.0)
    assert not is_covariance(-P, 0.0, 1e3) and not is_covariance(P - 2.0 * np.eye(6), 0.0, 1e3)


def test_other_shapes_are_not_valid() -> None:
    assert not is_position(np.zeros(2), 1.0) and not is_position(np.zeros(4), 1.0)
    assert not is_rotation(np.eye(2)) and not is_rotation(np.eye(4)) and not is_rotation(np.ones((3, 2)))
    assert not is_covariance(np.ones((6, 5)), 0.0, 1e3)


def test_what_compiled_checks_take() -> None:
    assert is_plain(P, 2) and is_plain(P.T[::2], 2) and is_plain(np.zeros(3), 1)
    for other in (P.astype(np.float32), P.astype(int), P.astype(">f8"), P.tolist(), P[0], np.ma.array(P)):
        assert not is_plain(other, 2)


@given(st.integers(0, 2**32 - 1), st.floats(-3.0, 3.0))
def test_definiteness_is_that_of_the_spectrum(seed: int, shift: float) -> None:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(6, 6))
    A = root @ root.T + shift * np.eye(6)
    least = np.linalg.eigvalsh(A)[0]
    if abs(least) > 1e-9:
        assert is_covariance(A, -1e9, 1e9) == (least > 0.0)
