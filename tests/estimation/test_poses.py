"""Rotations and poses against SciPy, matrices and drawn errors."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.integrate import quad_vec
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from coopenv.estimation import linalg
from coopenv.estimation.compiled import adjoint
from coopenv.estimation.poses import Coordinates, cholesky, exp_so3, exp_translation, riccati_covariance, solve
from tests.helpers.warp_calls import DTYPES, EPSILON, Calls
from tests.oracles.continuous import skew

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


def hat(xi: np.ndarray) -> np.ndarray:
    T = np.zeros((4, 4))
    T[:3, :3], T[:3, 3] = skew(xi[:3]), xi[3:]
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


def test_singular_input_is_refused() -> None:
    with pytest.raises(np.linalg.LinAlgError):
        cholesky(np.diag([1.0, -1.0]))
    with pytest.raises(np.linalg.LinAlgError):
        solve(np.ones((2, 2)), np.ones(2))


ROTATIONS = Rotation.random(200, random_state=0).as_matrix()
