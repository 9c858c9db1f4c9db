"""The update linearised half way, and the iterated one, against the optimum and numerical derivatives."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from coopenv.estimation.poses import right_jacobian
from coopenv.observers import Coordinates
from coopenv.observers.bearing_measurements import INVARIANT, LEFT, RIGHT, UncertainPose, recentring
from coopenv.observers.correction import iterated
from tests.observers.test_filters import derivative, kalman, pose, spd


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
