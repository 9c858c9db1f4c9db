"""How odometry carries the belief on, against differential equations that SciPy solves."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from coopenv.observers.contract import SensorNoise
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

AT: Pose = displaced((np.eye(3), np.zeros(3)), np.array([0.3, -0.2, 1.1, 0.5, -0.4, 0.2]))
TICKS = 90
V, W = np.array([2.0, 0.3, -0.1]), np.array([0.2, -0.1, 1.2])


def cross(w: np.ndarray) -> np.ndarray:
    return np.cross(np.eye(3), w)


def rate() -> np.ndarray:
    """Return the derivative of left errors (theta, rho) by themselves at a constant twist."""
    A = np.zeros((6, 6))
    A[:3, :3] = A[3:, 3:] = -cross(W)
    A[3:, :3] = -cross(V)
    return A


def step(dt: float) -> Pose:
    """Return the increment of a constant twist, as the exponential of a 4x4 matrix."""
    twist = np.zeros((4, 4))
    twist[:3, :3], twist[:3, 3] = cross(W), V
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
def test_what_lasts_is_in_the_covariance_as_in_drawn_trips(seed: int) -> None:
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
