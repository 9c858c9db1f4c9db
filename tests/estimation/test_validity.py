"""Validity of numbers, directions, rotations and covariances."""

from __future__ import annotations

import numpy as np

from coopenv.estimation.validity import are_covariances, are_numbers, are_rotations, are_unit_vectors
from tests.estimation.test_poses import ROTATIONS


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
