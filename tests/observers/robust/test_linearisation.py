"""What a bearing's linearisation leaves out, against Gauss-Hermite quadrature over the errors of both positions."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from numpy.polynomial.hermite_e import hermegauss
from numpy.testing import assert_allclose
from scipy.optimize import approx_fprime

from tests.helpers.robust_ticks import (
    LANDMARKS,
    MARKER,
    NOISE,
    Pose,
    covariance,
    direction,
    displaced,
    started,
    tick,
)

AT: Pose = displaced((np.eye(3), np.zeros(3)), np.array([0.3, -0.2, 1.1, 0.5, -0.4, 0.2]))
SLOW = 0.15
"""s between frames: no error is the same for two of them, and landmarks alone are not solved for at the first."""


def left_out(pose: Pose, point: np.ndarray, V: np.ndarray) -> float:
    """Return the variance (rad^2, both axes) of the direction that no linear function of the position's error is."""
    nodes, weights = hermegauss(9)
    C = np.linalg.cholesky(V)
    seen = direction(pose, point)

    def turned(rho: np.ndarray) -> np.ndarray:
        return direction((pose[0], pose[1] + pose[0] @ rho), point)

    J = approx_fprime(np.zeros(3), turned, 1e-6)
    total, sum_of_weights = 0.0, 0.0
    for n in product(range(9), repeat=3):
        weight = float(np.prod(weights[list(n)]))
        rho = C @ nodes[list(n)]
        error = turned(rho) - seen - J @ rho
        across = error - seen * (seen @ error)
        total, sum_of_weights = total + weight * float(across @ across), sum_of_weights + weight
    return total / sum_of_weights


def noise_of(P: np.ndarray, dt: float = SLOW) -> np.ndarray:
    """Return (5,) the variances of the bearings to landmarks beyond the camera's, rad^2."""
    observer = started(AT, P)
    observer.update(tick(observer, 1, bearings={n: direction(AT, LANDMARKS[n]) for n in range(5)}, dt=dt))
    return observer.memory.measurement["noise"][:5] - NOISE.bearing**2


@pytest.mark.parametrize("seed", range(4))
def test_the_variance_of_what_is_not_linear_counts_as_noise(seed: int) -> None:
    """It is counted as s^2 t^2 / d^4 of deviations s along and t across: to leading order of independent ones."""
    P = covariance(np.random.default_rng(seed), 1e-4, 0.3)
    expected = np.array([left_out(AT, point, P[3:, 3:]) for point in LANDMARKS])
    P[3:, 3:] -= NOISE.odometry(SLOW)[3] * np.eye(3)  # what is added before the frame
    P[:3, 3:] = P[3:, :3] = 0.0
    ratio = noise_of(P) / expected
    assert (ratio > 0.6).all() and (ratio < 1.5).all(), ratio


def test_it_grows_with_the_fourth_power_of_the_uncertainty() -> None:
    P = np.diag([1e-8] * 3 + [0.03**2] * 3)
    assert_allclose(noise_of(4.0 * P, 1e-3) / noise_of(P, 1e-3), 16.0, rtol=0.05)


def test_frames_in_which_it_is_the_same_count_as_one() -> None:
    """Ten times as many frames within the time for which it lasts: each with ten times the variance."""
    P = np.diag([1e-8] * 3 + [0.05**2] * 3)
    assert_allclose(noise_of(P, 1e-3) / noise_of(P, 1e-2), 10.0, rtol=0.05)


def test_that_of_a_sender_counts_by_the_errors_of_both() -> None:
    """Both uncertain by the same: variances of relative positions double, and the product grows fourfold."""
    P = np.diag([1e-10] * 3 + [0.05**2] * 3)
    tight = np.diag([1e-10] * 3 + [1e-6] * 3)
    there = displaced((np.eye(3), np.array([5.0, -3.0, 1.0])), np.zeros(6))
    noise = []
    for own, theirs in ((P, tight), (tight, P), (P, P)):
        observer, sender = started(AT, own), started(there, theirs, 1)
        sender.update(tick(sender, 1))
        b = direction(AT, there[1] + there[0] @ MARKER)
        observer.update(tick(observer, 1, bearings={6: b}, messages={1: (sender.message(), 0.0)}))
        noise.append(observer.memory.measurement["noise"][0] - NOISE.bearing**2)
    assert noise[0] > 0.0
    assert_allclose(noise[1], noise[0], rtol=0.05)
    assert_allclose(noise[2], 4.0 * noise[0], rtol=0.05)
