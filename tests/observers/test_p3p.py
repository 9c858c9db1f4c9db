"""Poses from three bearings: solutions see the points where they are, and degenerate input gives none."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from coopenv.observers.p3p import solve_p3p
from tests.observers.test_filters import derivative

SEEDS = st.integers(0, 2**32 - 1)


def scene(seed: int, spread: float = 10.0) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return (rotation, camera, points (3, 3), bearings (3, 3))."""
    rng = np.random.default_rng(seed)
    R, c = Rotation.random(None, rng).as_matrix(), rng.uniform(-5, 5, 3)
    z = rng.uniform(-spread, spread, (3, 3))
    return R, c, z, seen(R, c, z)


def solve_one(bearings: np.ndarray, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rotations (n, 3, 3) and camera positions (n, 3), n = 0..4, for bearings and positions (3, 3)."""
    R, c, mask = solve_p3p(np.asarray(bearings)[None], np.asarray(positions)[None])
    return R[0, mask[0]], c[0, mask[0]]


def seen(R: np.ndarray, c: np.ndarray, z: np.ndarray) -> np.ndarray:
    d = (z - c) @ R
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def conditioning(R: np.ndarray, c: np.ndarray, z: np.ndarray) -> float:
    """Return the smallest singular value of the bearings' derivative by the pose; 0 on the danger cylinder."""
    J = derivative(lambda e: seen(R @ Rotation.from_rotvec(e[:3]).as_matrix(), c + e[3:], z).ravel())
    return float(np.linalg.svd(J, compute_uv=False).min())


@settings(max_examples=200, deadline=None)
@given(seed=SEEDS, shift=st.floats(-1e4, 1e4))
def test_the_true_pose_is_among_the_solutions_and_all_see_the_points_where_they_are(seed: int, shift: float) -> None:
    """They are ordered by the distance from the first point."""
    R, c, z, b = scene(seed)
    rotations, cameras = solve_one(b, z)
    error = np.linalg.norm(cameras - c, axis=1) + np.linalg.norm(rotations - R, axis=(1, 2))
    assert conditioning(R, c, z) < 1e-3 or error.min() < 1e-6
    z = z + shift
    rotations, cameras = solve_one(b, z)
    assert len(rotations) == len(cameras) <= 4
    assert (np.diff(np.linalg.norm(cameras - z[0], axis=1)) > -1e-9).all()
    for R, c in zip(rotations, cameras, strict=True):
        assert_allclose(seen(R, c, z), b, atol=1e-4)  # a double solution has half the digits
        assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
        assert_allclose(np.linalg.det(R), 1.0, atol=1e-12)


def test_four_solutions_of_a_symmetric_scene() -> None:
    """Above the centre of an equilateral triangle, near it: the symmetric pose and one tilted about each corner."""
    angles = np.arange(3) * 2 * np.pi / 3
    z = np.stack([np.cos(angles), np.sin(angles), np.zeros(3)], axis=1)
    c = np.array([0.0, 0.0, 2.0])
    rotations, cameras = solve_one(seen(np.eye(3), c, z), z)
    assert len(rotations) == 4
    heights = np.sort(np.linalg.norm(cameras - c, axis=1))
    assert_allclose(heights[0], 0.0, atol=1e-9)
    assert_allclose(heights[1:], heights[1], rtol=1e-9)  # the other three turn into one another by 120 degrees
    assert heights[1] > 0.1


def test_points_behind_are_not_taken_for_points_ahead() -> None:
    """The mirror of the true pose sees the same lines backwards; only a solver without signs gives it."""
    R, c, z, b = scene(3)
    for rotation, camera in zip(*solve_one(-b, z), strict=True):
        assert ((seen(rotation, camera, z) * -b).sum(1) > 0.999).all()
    assert not any(np.linalg.norm(camera - c) < 1e-6 for camera in solve_one(-b, z)[1])
    assert R.shape == (3, 3)


def test_the_batch_is_the_single_solver_row_by_row() -> None:
    scenes = [scene(seed) for seed in range(20)]
    b, z = np.stack([s[3] for s in scenes]), np.stack([s[2] for s in scenes])
    z[4, 2] = z[4, 0] + 2 * (z[4, 1] - z[4, 0])  # on a line
    R, c, mask = solve_p3p(b, z)
    assert R.shape == (20, 4, 3, 3) and c.shape == (20, 4, 3)
    assert not mask[4].any() and mask[np.arange(20) != 4].any(1).all()
    assert np.isnan(R[~mask]).all() and np.isnan(c[~mask]).all() and np.isfinite(R[mask]).all()
    for k in range(20):
        rotations, cameras = solve_one(b[k], z[k])
        assert_allclose(rotations, R[k, mask[k]], atol=1e-9)
        assert_allclose(cameras, c[k, mask[k]], atol=1e-9)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("bearings", "points"),
    [
        (np.full((3, 3), np.nan), np.eye(3)),
        (np.eye(3), np.full((3, 3), np.inf)),
        (np.eye(3), np.zeros((3, 3))),
        (np.eye(3), np.outer([1.0, 2.0, 4.0], [1.0, 1.0, 0.0])),
        (np.zeros((3, 3)), np.eye(3)),
        (np.eye(3) * 1e300, np.eye(3)),
        (np.tile([1.0, 0.0, 0.0], (3, 1)), np.eye(3)),
        (np.eye(3), np.eye(3) * 1e-200),
        (np.eye(3), np.eye(3) * 1e200),
    ],
)
def test_degenerate_input_gives_no_solution(bearings: np.ndarray, points: np.ndarray) -> None:
    rotations, cameras = solve_one(bearings, points)
    assert rotations.shape == (0, 3, 3) and cameras.shape == (0, 3)


@pytest.mark.filterwarnings("error")
@settings(max_examples=200, deadline=None)
@given(seed=SEEDS, flatness=st.floats(1e-16, 1e-3), closeness=st.floats(1e-16, 1e-3))
def test_nearly_degenerate_input_raises_nothing(seed: int, flatness: float, closeness: float) -> None:
    rng = np.random.default_rng(seed)
    b = np.array([1.0, 0.0, 0.0]) + closeness * rng.normal(size=(3, 3))
    b /= np.linalg.norm(b, axis=1, keepdims=True)
    z = np.outer(rng.normal(size=3), rng.normal(size=3)) + flatness * rng.normal(size=(3, 3))
    rotations, cameras = solve_one(b, z)
    assert np.isfinite(rotations).all() and np.isfinite(cameras).all()
