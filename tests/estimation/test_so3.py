"""Rotations in Warp against SciPy's, near zero and near half a turn included."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.integrate import quad_vec
from scipy.spatial.transform import Rotation

from coopenv.estimation import linalg
from tests.helpers.warp_calls import DTYPES, EPSILON, Calls

ANGLES = np.concatenate(
    [
        [0.0],
        np.logspace(-16, 0, 65),
        [1e-4 * (1 - 1e-9), 1e-4 * (1 + 1e-9), 1e-2 * (1 - 1e-9), 1e-2 * (1 + 1e-9)],  # series begin here
        np.pi - np.logspace(-15, 0, 46),
        [np.pi],
    ]
)
call = Calls(
    __name__,
    {linalg.exp_so3: "3 > 33", linalg.rigid_motion: "3 3 > 33 3", linalg.rotation_angle: "33 > 1"},
    {linalg.quaternion_vector: "33 > 3", linalg.orthonormalise: "33 > 33"},
)
LARGE = np.array([3.5, 2 * np.pi - 1e-3, 2 * np.pi, 9.0, 40.0])
component = st.floats(-1.0, 1.0, allow_subnormal=False)
vectors = st.tuples(component, component, component).map(np.array)
rotation_vectors = st.tuples(vectors, st.floats(-12.0, 0.9)).map(lambda x: x[0] * 10.0 ** x[1])


def axes(count: int, seed: int = 0) -> np.ndarray:
    """Return unit vectors, the coordinate axes and their sums among them."""
    grid = np.array(np.meshgrid([-1, 0, 1], [-1, 0, 1], [-1, 0, 1])).reshape(3, -1).T
    grid = grid[np.any(grid != 0, axis=1)].astype(float)
    both = np.concatenate([grid, np.random.default_rng(seed).normal(size=(count, 3))])
    return both / np.linalg.norm(both, axis=1, keepdims=True)


def turns(angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rotation vectors (K, 3) of every angle about every axis, and the angles (K,)."""
    u = axes(20)
    return (angles[:, None, None] * u).reshape(-1, 3), np.repeat(angles, len(u))


@pytest.mark.parametrize("dtype", DTYPES)
def test_exponential_is_scipys(dtype: str) -> None:
    w, _ = turns(np.concatenate([ANGLES, LARGE]))
    w = w.astype(dtype).astype(float)
    tolerance = 8 * EPSILON[dtype] * np.maximum(1.0, np.linalg.norm(w, axis=1))
    error = np.abs(call(linalg.exp_so3, dtype, w) - Rotation.from_rotvec(w).as_matrix()).max(axis=(1, 2))
    assert (error <= tolerance).all()


def test_small_turns_keep_their_relative_accuracy() -> None:
    w = np.array([[1e-9, -2e-9, 3e-9]])
    R = call(linalg.exp_so3, "float64", w)[0]
    assert_allclose((R - R.T)[[2, 0, 1], [1, 2, 0]] / 2, w[0], rtol=1e-14)


@given(rotation_vectors, vectors)
@settings(max_examples=100, deadline=None)
def test_a_rigid_motion_turns_and_goes_as_far_as_its_mean_rotation(w: np.ndarray, u: np.ndarray) -> None:
    mean, _ = quad_vec(lambda s: Rotation.from_rotvec(s * w).as_matrix(), 0.0, 1.0, epsabs=1e-13, epsrel=1e-13)
    turn, way = call(linalg.rigid_motion, "float64", w[None], u[None])
    assert_allclose(turn[0], Rotation.from_rotvec(w).as_matrix(), atol=1e-12)
    assert_allclose(way[0], mean @ u, atol=1e-12)


def test_a_rigid_motion_in_float32_follows_float64() -> None:
    w = turns(np.concatenate([ANGLES, LARGE]))[0].astype(np.float32)
    u = np.broadcast_to(np.float32([1.0, -0.5, 0.3]), w.shape)
    _, single = call(linalg.rigid_motion, "float32", w, u)
    _, double = call(linalg.rigid_motion, "float64", w, u)
    assert_allclose(single, double, atol=1e-6)


@pytest.mark.parametrize(("dtype", "tolerance"), [("float64", 1e-12), ("float32", 1e-6)])
def test_angle_is_accurate_everywhere(dtype: str, tolerance: float) -> None:
    w, angle = turns(ANGLES)
    R = Rotation.from_rotvec(w).as_matrix()
    assert_allclose(call(linalg.rotation_angle, dtype, R), angle, atol=tolerance, rtol=0)


def test_angle_between_near_rotations() -> None:
    """The rotations themselves are of any size; only their difference is small or near a half turn."""
    base = Rotation.random(200, np.random.default_rng(1)).as_matrix()
    for angle in (1e-10, 1e-6, np.pi - 1e-10, np.pi - 1e-6):
        other = base @ Rotation.from_rotvec(angle * axes(174)[:200]).as_matrix()
        between = call(linalg.rotation_angle, "float64", np.swapaxes(base, 1, 2) @ other)
        assert_allclose(between, angle, atol=1e-14 if angle < 1 else 1e-12, rtol=1e-5)


def test_quaternion_vector_near_half_turns() -> None:
    angles = np.concatenate([ANGLES, 2 * np.arccos([0.1 + 1e-9, 0.1 - 1e-9, 0.09, 0.11])])
    w, angle = turns(angles)
    expected = np.sin(angle / 2)[:, None] * w / np.where(angle > 0, angle, 1.0)[:, None]
    lam = call(linalg.quaternion_vector, "float64", Rotation.from_rotvec(w).as_matrix())
    sign = np.ones(len(w))
    tiny = angle > np.pi - 20 * EPSILON["float64"]  # the two signs are one rotation there
    sign[tiny] = np.where((lam * expected).sum(axis=1)[tiny] < 0, -1.0, 1.0)
    assert_allclose(sign[:, None] * lam, expected, atol=12 * EPSILON["float64"])
    assert tiny.mean() < 0.1


@given(st.tuples(component, component, component, component))
@settings(max_examples=200, deadline=None)
def test_quaternion_vector_is_scipys(q: tuple[float, float, float, float]) -> None:
    if np.linalg.norm(q) < 1e-3:
        return
    rotation = Rotation.from_quat(q)
    lam = call(linalg.quaternion_vector, "float64", rotation.as_matrix()[None])[0]
    scalar, *vector = rotation.as_quat(canonical=True, scalar_first=True)
    near = min(np.abs(lam - vector).max(), np.abs(lam + vector).max() + (np.inf if scalar > 1e-15 else 0.0))
    assert near < 1e-14


def test_orthonormalise_removes_the_first_order() -> None:
    rng = np.random.default_rng(2)
    R = Rotation.random(100, rng).as_matrix()
    dent = 1e-4 * rng.uniform(-1, 1, (100, 3, 3))
    mended = call(linalg.orthonormalise, "float64", R + dent)
    gram = np.swapaxes(mended, 1, 2) @ mended - np.eye(3)
    assert np.abs(gram).max() < 5e-7
    u, _, vt = np.linalg.svd(R + dent)
    assert_allclose(mended, u @ vt, atol=5e-7)  # the nearest rotation, not just any
    assert np.abs(mended - R).max() < 3e-4
