"""One frame's correction against SciPy: non-linear least squares, and numerical derivatives for considered errors.

What a bearing's linearisation leaves out is compared with Gauss-Hermite quadrature over the errors of both positions.
"""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from numpy.polynomial.hermite_e import hermegauss
from numpy.testing import assert_allclose
from scipy.linalg import eigvalsh, null_space
from scipy.optimize import approx_fprime, least_squares

from tests.helpers.robust_ticks import (
    LANDMARKS,
    MARKER,
    NOISE,
    Pose,
    covariance,
    direction,
    displaced,
    drawn,
    left_error,
    measured,
    pose_of,
    predicted,
    started,
    tick,
)

AT: Pose = displaced((np.eye(3), np.zeros(3)), np.array([0.3, -0.2, 1.1, 0.5, -0.4, 0.2]))


def least_cost(prior: Pose, P: np.ndarray, bearings: dict[int, np.ndarray]) -> tuple[Pose, np.ndarray, np.ndarray]:
    """Return the most probable pose and calibration, and their covariance, from a prior and bearings to landmarks."""
    whiten = np.linalg.inv(np.linalg.cholesky(P))

    def residuals(e: np.ndarray, about: np.ndarray) -> np.ndarray:
        pose = displaced(displaced(prior, about[:6]), e[:6])
        seen = [(direction(pose, LANDMARKS[n]) - b) / NOISE.bearing for n, b in bearings.items()]
        return np.concatenate([whiten @ [*left_error(prior, pose), *(about + e)[6:]], *seen])

    none = np.zeros(12)
    best = least_squares(residuals, none, x_scale="jac", args=(none,)).x
    J = least_squares(residuals, none, max_nfev=1, args=(best,)).jac
    return displaced(prior, best[:6]), best[6:], np.linalg.inv(J.T @ J)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize(("angle", "length"), [(0.01, 0.04), (0.1, 0.4)])
def test_a_frame_of_landmarks_is_a_least_squares(angle: float, length: float, seed: int) -> None:
    """Small errors: the same pose and covariance. Large ones: near it, and vaguer, as linearisations err."""
    rng = np.random.default_rng(seed)
    P = covariance(rng, angle, length)
    truth = drawn(rng, AT, P)
    bearings = {n: measured(truth, LANDMARKS[n], rng) for n in range(5)}
    observer = started(AT, P)
    observer.update(tick(observer, 1, bearings=bearings))
    best, calibration, expected = least_cost(AT, predicted(P), bearings)
    errors = observer.members[1]
    off = np.concatenate([left_error(best, pose_of(observer)), [*errors["w"], *errors["v"]] - calibration])
    small = angle < 0.05
    assert np.sqrt(off @ np.linalg.solve(expected if small else observer.P, off)) < (0.1 if small else 2.0)
    ratio = eigvalsh(observer.P, expected)
    assert ratio[0] > 0.98 and ratio[-1] < (1.1 if small else 60.0)


def schmidt(
    own: Pose, P: np.ndarray, sender: Pose, Q: np.ndarray, b: np.ndarray
) -> tuple[Pose, np.ndarray, np.ndarray]:
    """Return the vehicle's pose, its covariance and that with the sender's error, which stays as it is."""
    T = null_space(direction(own, sender[1] + sender[0] @ MARKER)[None]).T

    def seen(e: np.ndarray) -> np.ndarray:
        place, turn = displaced(sender, e[6:])[1], displaced(sender, e[6:])[0]
        return np.asarray(T @ direction(displaced(own, e[:6]), place + turn @ MARKER))

    H = approx_fprime(np.zeros(12), seen, 1e-7)
    A, B = H[:, :6], H[:, 6:]
    S = A @ P @ A.T + B @ Q @ B.T + NOISE.bearing**2 * np.eye(2)
    K = P @ A.T @ np.linalg.inv(S)
    return displaced(own, K @ (T @ b)), P - K @ S @ K.T, -K @ B @ Q


@pytest.mark.parametrize("seed", range(4))
def test_a_sender_s_error_is_considered(seed: int) -> None:
    """Its variance counts in the gain, its pose stays, and the errors of both correlate afterwards."""
    rng = np.random.default_rng(seed)
    there = displaced((np.eye(3), np.array([5.0, -3.0, 1.0])), rng.normal(size=6) * 0.3)
    P, Q = covariance(rng, 0.004, 0.02), covariance(rng, 0.004, 0.02)
    observer, sender = started(AT, P), started(there, Q, 1)
    sender.update(tick(sender, 1))
    message = sender.message()
    point = message.position
    assert point is not None and message.rotation is not None
    reported = message.rotation, point - message.rotation @ MARKER
    truth = drawn(rng, AT, P)
    b = measured(truth, drawn(rng, there, Q)[1] + there[0] @ MARKER, rng)
    observer.update(tick(observer, 1, bearings={6: b}, messages={1: (message, 0.0)}))
    P, Q = predicted(P)[:6, :6], sender.P[:6, :6]
    pose, expected, cross = schmidt(AT, P, reported, Q, b)
    scale = np.sqrt(P.diagonal())
    assert_allclose(observer.members["pose"]["p"][-1], point, atol=1e-6)
    assert np.abs(left_error(pose, pose_of(observer)) / scale).max() < 0.05
    assert_allclose(observer.P[:6, :6] / np.outer(scale, scale), expected / np.outer(scale, scale), atol=0.03)
    # a member stands at its marker: its translation is that of the point, its rotation its own
    to_marker = np.eye(6)
    to_marker[3:, :3] = -np.cross(np.eye(3), MARKER)
    at_marker = cross @ to_marker.T
    other = np.sqrt((to_marker @ Q @ to_marker.T).diagonal())
    assert np.abs(at_marker / np.outer(scale, other)).max() > 0.1
    assert_allclose(observer.P[:6, 12:] / np.outer(scale, other), at_marker / np.outer(scale, other), atol=0.03)


def test_a_target_behind_the_camera_corrects_nothing() -> None:
    P = covariance(np.random.default_rng(0), 0.01, 0.04)
    observer, other = started(AT, P), started(AT, P)
    observer.update(tick(observer, 1, bearings={0: -direction(AT, LANDMARKS[0])}))
    other.update(tick(other, 1))
    assert_allclose(observer.P, other.P)


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


def test_linearisation_variance_grows_with_the_fourth_power_of_the_uncertainty() -> None:
    P = np.diag([1e-8] * 3 + [0.03**2] * 3)
    assert_allclose(noise_of(4.0 * P, 1e-3) / noise_of(P, 1e-3), 16.0, rtol=0.05)


def test_frames_in_which_it_is_the_same_count_as_one() -> None:
    """Ten times as many frames within the time for which it lasts: each with ten times the variance."""
    P = np.diag([1e-8] * 3 + [0.05**2] * 3)
    assert_allclose(noise_of(P, 1e-3) / noise_of(P, 1e-2), 10.0, rtol=0.05)


def test_linearisation_variance_of_a_sender_counts_the_errors_of_both() -> None:
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
