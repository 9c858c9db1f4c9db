"""Functions of the observer against SciPy: errors, matrices and propagation."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import warp as wp
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp
from scipy.linalg import eigh, expm
from scipy.spatial.transform import Rotation

from coopenv.observers.contract import SensorNoise
from coopenv.observers.robust.algebra import Pose as PoseRecord
from coopenv.observers.robust.algebra import forward, inverse6, is_regular, left_error, log_so3
from coopenv.observers.robust.correlations import excess
from tests.helpers.robust_ticks import (
    CALIBRATION,
    NOISE,
    PERIOD,
    WALK,
    Pose,
    covariance,
    displaced,
    pose_of,
    started,
    tick,
)
from tests.helpers.warp_calls import Calls
from tests.oracles.continuous import skew


@wp.func
def error_of(R: Any, p: Any, other_R: Any, other_p: Any):
    """Return the left error of another pose."""
    return left_error(PoseRecord(R, p), PoseRecord(other_R, other_p))


@wp.func
def transition_of(R: Any, p: Any):
    """Return the transition over an increment."""
    return forward(PoseRecord(R, p), wp.identity(6, wp.float64))


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


def test_a_sender_is_inflated_where_correlations_contradict_its_covariance() -> None:
    """The residual becomes semidefinite, and no more is added."""
    rng = np.random.default_rng(0)
    A = rng.normal(size=(100, 6, 6)) * np.repeat([0.01, 0.3], 3)[:, None]  # of poses: rad and m
    after = A @ np.swapaxes(A, 1, 2) + 1e-8 * np.eye(6)
    values = rng.uniform(-1.0, 1.0, (100, 6))
    values[20:, 0] = -np.abs(values[20:, 0])
    values[:20] = rng.uniform(0.01, 1.0, (20, 6))  # nothing contradicts
    B = np.linalg.cholesky(after) @ np.linalg.qr(rng.normal(size=(100, 6, 6)))[0]
    left = (B * values[:, None]) @ np.swapaxes(B, 1, 2)
    added = call(excess, left, after)
    assert (added[:20] == 0.0).all()
    assert (np.abs(added[20:]).max(axis=(1, 2)) > 0.0).all()
    for one, reported, more in zip(left, after, added, strict=True):
        before, axes = eigh(one, reported)
        now = axes.T @ (one + more) @ axes
        assert_allclose(now, np.diag(np.maximum(before, 0.0)), atol=1e-9)


AT: Pose = displaced((np.eye(3), np.zeros(3)), np.array([0.3, -0.2, 1.1, 0.5, -0.4, 0.2]))
TICKS = 90
V, W = np.array([2.0, 0.3, -0.1]), np.array([0.2, -0.1, 1.2])


def rate() -> np.ndarray:
    """Return the derivative of left errors (theta, rho) by themselves at a constant twist."""
    A = np.zeros((6, 6))
    A[:3, :3] = A[3:, 3:] = -skew(W)
    A[3:, :3] = -skew(V)
    return A


def step(dt: float) -> Pose:
    """Return the increment of a constant twist, as the exponential of a 4x4 matrix."""
    twist = np.zeros((4, 4))
    twist[:3, :3], twist[:3, 3] = skew(W), V
    T = expm(dt * twist)
    return T[:3, :3], T[:3, 3]


def rate_with_calibration() -> np.ndarray:
    """Return the derivative of left errors, gyro bias and scale error by themselves at a constant twist."""
    A = np.zeros((10, 10))
    A[:6, :6], A[:3, 6:9], A[3:6, 9] = rate(), -np.eye(3), -V
    return A


@pytest.mark.parametrize("seed", range(3))
def test_the_covariance_follows_its_differential_equation(seed: int) -> None:
    P = np.zeros((10, 10))
    P[:6, :6], P[6:, 6:] = covariance(np.random.default_rng(seed), 0.02, 0.05), CALIBRATION[:4, :4]
    observer = started(AT, P[:6, :6])
    for k in range(1, TICKS + 1):
        observer.update(tick(observer, k, step(PERIOD)))
    A, Q = rate_with_calibration(), np.diag([*NOISE.odometry(1.0), *[WALK**2] * 3, 0.0])

    def slope(t: float, x: np.ndarray) -> np.ndarray:
        X = x.reshape(10, 10)
        return np.asarray(A @ X + X @ A.T + Q).ravel()

    expected = solve_ivp(slope, (0.0, TICKS * PERIOD), P.ravel(), rtol=1e-9, atol=1e-14).y[:, -1].reshape(10, 10)
    scale = np.sqrt(np.outer(expected.diagonal(), expected.diagonal()))
    assert_allclose(observer.P[:10, :10] / scale, expected / scale, atol=0.01)
    assert np.abs(expected / scale)[:6, 6:9].max() > 0.05
    R, p = step(TICKS * PERIOD)
    assert_allclose(pose_of(observer)[0], AT[0] @ R, atol=1e-9)
    assert_allclose(pose_of(observer)[1], AT[1] + AT[0] @ p, atol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_systematic_errors_are_in_the_covariance_as_in_drawn_trips(seed: int) -> None:
    """A gyro's bias and a scale error, drawn: the errors of the pose at the end have the covariance that is stated."""
    bias, scale = (0.01, 0.02, 0.015), 0.05
    noise = SensorNoise(1e-3, 1e-4, PERIOD, 0.003, odometry_scale=scale, gyro_bias=bias)
    rng = np.random.default_rng(seed)
    P = covariance(rng, 0.002, 0.005)
    observer = started(AT, P, noise=noise)
    for k in range(1, TICKS + 1):
        observer.update(tick(observer, k, step(PERIOD)))
    F = expm(TICKS * PERIOD * rate_with_calibration())
    start = np.zeros((10, 10))
    start[:6, :6], start[6:, 6:] = P, np.diag([*np.square(bias), scale**2])
    expected = F @ start @ F.T
    size = np.sqrt(np.outer(expected.diagonal(), expected.diagonal()))
    assert_allclose(observer.P[:10, :10] / size, expected / size, atol=0.03)


def test_held_samples_are_carried_on_to_the_end_of_their_tick() -> None:
    """The sum of samples that are held from the beginning of each tick is short of the turn by 1.1 % here."""
    observer, turning = started(AT, 1e-6 * np.eye(6)), np.array([0.0, 0.0, 0.5])
    for k in range(1, TICKS + 1):
        held = (k - 1) * PERIOD * turning
        observer.update(tick(observer, k, (Rotation.from_rotvec(held * PERIOD).as_matrix(), np.zeros(3))))
    turned = Rotation.from_matrix(AT[0].T @ pose_of(observer)[0]).as_rotvec()
    assert_allclose(turned, 0.5 * turning * (TICKS * PERIOD) ** 2, rtol=1e-3, atol=1e-9)
