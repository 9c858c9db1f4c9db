"""The update linearised half way, the iterated one, and the filters on SE(3): against the optimum and derivatives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import logm
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from coopenv.estimation.poses import right_jacobian
from coopenv.observers import Coordinates, Estimate, SensorNoise, run
from coopenv.observers.bearing_measurements import INVARIANT, LEFT, RIGHT, UncertainPose, recentring
from coopenv.observers.correction import iterated
from coopenv.observers.error_state_filters import SPREAD, LeftInvariant, Mekf, Ukf, sigma_points
from tests.observers.test_filters import QUIET, derivative, kalman, pose, spd, tick
from tests.oracles.batch import assert_same_covariance, small_record


@pytest.mark.parametrize("angle", [1e-5, 0.3, 2.5])
def test_right_jacobian_is_the_derivative_of_the_exponential(angle: float) -> None:
    w = angle * np.array([0.6, -0.48, 0.64])
    numeric = derivative(lambda d: (Rotation.from_rotvec(w).inv() * Rotation.from_rotvec(w + d)).as_rotvec(), 3, 1e-6)
    assert_allclose(right_jacobian(w), numeric, atol=1e-8)


@pytest.mark.parametrize("kind", [LEFT, RIGHT])
def test_recentring_is_the_derivative_of_the_error_that_is_left(kind: int) -> None:
    start = UncertainPose(kind, *pose(4), np.eye(6))
    dx = np.array([0.3, -0.2, 0.4, 1.0, -0.5, 2.0])
    moved = start.moved(dx, start.P)
    coordinates = Coordinates.LEFT if kind == LEFT else Coordinates.RIGHT

    def left(d: np.ndarray) -> np.ndarray:
        truth = start.moved(dx + d, start.P)
        return coordinates.error(truth.R, truth.p, moved.R, moved.p)

    assert_allclose(recentring(kind, dx), derivative(left), atol=1e-7)


def test_recentring_of_the_invariant_error() -> None:
    start = UncertainPose(INVARIANT, *pose(4), np.eye(6))
    dx = np.array([0.1, -0.2, 0.1, 1.0, -0.5, 2.0])
    G, d = recentring(INVARIANT, dx), 1e-6 * np.arange(1.0, 7.0)
    one, other = start.moved(dx + d, start.P), start.moved(dx, start.P)
    again = other.moved(G @ d, start.P)
    assert_allclose(again.p, one.p, atol=1e-9)
    assert_allclose(again.R, one.R, atol=1e-9)
    assert np.abs(G - np.eye(6)).max() > 0.1


def test_of_a_linear_measurement_it_is_the_kalman_update() -> None:
    rng = np.random.default_rng(0)
    P, H, N, r = spd(rng, 6), rng.normal(size=(4, 6)), spd(rng, 4), rng.normal(size=4)
    look = lambda at: (r - H @ at, H, N)  # noqa: E731
    for found, expected in zip(iterated(P, look, np.linalg.norm), kalman(P, H, N, r), strict=True):
        assert_allclose(found, expected, atol=1e-9)


def test_the_iterated_one_ends_at_the_most_probable_state() -> None:
    """A bearing in the plane to a point nearby, which is far from linear."""
    P, N, measured = np.diag([1.0, 1.0]), np.array([[1e-3]]), 1.2

    def angle(x: np.ndarray) -> float:
        return float(np.arctan2(2.0 - x[1], 1.0 - x[0]))

    def look(at: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        d = np.array([1.0, 2.0]) - at
        return np.array([measured - angle(at)]), np.array([[d[1], -d[0]]]) / (d @ d), N

    dx, _, _ = iterated(P, look, np.linalg.norm)
    best = minimize(lambda x: x @ np.linalg.solve(P, x) + (measured - angle(x)) ** 2 / N[0, 0], [0.0, 0.0], tol=1e-12)
    assert_allclose(dx, best.x, atol=1e-3)


# Filters on SE(3)


LARGE = np.array([1.1, -0.7, 0.9, 3.0, -2.0, 5.0])


def matrix(state: UncertainPose) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = state.R, state.p
    return T


def invariant_error(truth: UncertainPose, estimate: UncertainPose) -> np.ndarray:
    X = logm(np.linalg.inv(matrix(estimate)) @ matrix(truth)).real
    return np.array([X[2, 1], X[0, 2], X[1, 0], *X[:3, 3]])


def test_moving_by_an_error_of_any_size_makes_that_error() -> None:
    state = UncertainPose(INVARIANT, *pose(0), np.eye(6))
    assert_allclose(invariant_error(state.moved(LARGE, state.P), state), LARGE, atol=1e-9)


def test_prediction_of_a_large_error_is_linear() -> None:
    """Group affinity: the outer product of one error is carried exactly, which first order would miss by metres."""
    state, t = UncertainPose(INVARIANT, *pose(1), np.outer(LARGE, LARGE)), tick(2, QUIET)
    after = state.predicted(t)
    error = invariant_error(state.moved(LARGE, state.P).predicted(t), after)
    assert_allclose(after.P, np.outer(error, error), atol=1e-8)


@pytest.mark.parametrize("name", ["left_invariant", "ukf"])
def test_a_neighbour_counts_as_in_the_filter_of_left_errors(name: str) -> None:
    """With small errors all filters that take the neighbour's covariance as noise are the same."""
    made = small_record()
    expected, result = run("mekf_covariance", made), run(name, made)
    std = np.sqrt(expected.covariance[-1][:, range(6), range(6)])
    assert_allclose((result.position - expected.position)[-1] / std[:, 3:], 0.0, atol=0.01)
    assert_same_covariance(result.covariance[-1], expected.covariance[-1])
    assert_allclose(result.nis[-1], expected.nis[-1], rtol=0.01)
    assert (result.nis_dof[-1] == expected.nis_dof[-1]).all()


def test_sigma_points_have_the_moments() -> None:
    P = spd(np.random.default_rng(3), 6)
    xi = sigma_points(P)
    assert_allclose(xi.sum(0), 0.0, atol=1e-12)
    assert_allclose(xi.T @ xi / (2 * SPREAD), P, atol=1e-12)
    flat = np.diag([1.0, 2.0, 0.0, 0.0, 3.0, 0.0])
    assert_allclose(sigma_points(flat).T @ sigma_points(flat) / (2 * SPREAD), flat, atol=1e-12)


def test_sigma_points_count_the_curvature_that_a_derivative_misses() -> None:
    """After one frame at 60 degrees and 3 m, the filter of derivatives is far surer of the position."""
    made = small_record(1)
    truth = UncertainPose(INVARIANT, made.truth.rotation[1, 0], made.truth.position[1, 0], np.eye(6))
    start = truth.moved(np.array([0.0, 0.0, 1.05, 3.0, 0.0, 0.0]), truth.P)
    noise = SensorNoise(0.0, 0.0, made.dt, 0.02)
    still = replace(made.tick(1, 0, {}), rotation=np.eye(3), translation=np.zeros(3), noise=noise)

    def after_one_frame(own: Mekf) -> Estimate:
        own.reset((start.R, start.p), np.diag([0.5] * 3 + [9.0] * 3))
        return own.update(still)

    unscented, linear = after_one_frame(Ukf(made.setups[0])), after_one_frame(LeftInvariant(made.setups[0]))
    assert np.trace(unscented.covariance[3:, 3:]) > 2.0 * np.trace(linear.covariance[3:, 3:])
    squared = []
    for estimate in (unscented, linear):
        e = Coordinates.LEFT.error(truth.R, truth.p, estimate.rotation, estimate.position)
        squared.append(e @ np.linalg.solve(estimate.covariance, e))
    assert squared[0] < 0.5 * squared[1]
