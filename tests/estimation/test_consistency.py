"""Chi-square bounds, intervals of shares, divergence, and standard deviations in every error's coordinates."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import binomtest

from coopenv.estimation.metrics import diverged, mean_bounds, position_std, wilson_interval
from coopenv.estimation.poses import Coordinates


def test_bounds_of_a_reference() -> None:
    """20 runs of 6 degrees of freedom: 0.76 .. 1.27."""
    assert mean_bounds(6, 20) == pytest.approx((0.763, 1.268), abs=1e-3)


def test_bounds_hold_what_they_promise() -> None:
    low, high = mean_bounds(3, 8)
    means = np.random.default_rng(0).chisquare(3, size=(4000, 8)).mean(axis=1) / 3
    assert np.mean((means > low) & (means < high)) == pytest.approx(0.95, abs=0.015)


@pytest.mark.parametrize(("successes", "trials"), [(0, 7), (3, 10), (199, 200), (200, 200)])
def test_wilson_is_scipy_s(successes: int, trials: int) -> None:
    expected = binomtest(successes, trials).proportion_ci(0.95, method="wilson")
    assert wilson_interval(successes, trials) == pytest.approx((expected.low, expected.high), abs=1e-12)


def test_nothing_is_known_without_trials() -> None:
    assert wilson_interval(0, 0) == (0.0, 1.0)


def test_divergence() -> None:
    position, orientation = np.array([4.9, 5.1, 1.0, np.nan]), np.array([29.0, 1.0, 31.0, 1.0])
    assert diverged(position, orientation).tolist() == [False, True, True, True]


@pytest.mark.parametrize("coordinates", list(Coordinates))
def test_position_std_is_that_of_drawn_errors(coordinates: Coordinates) -> None:
    """Small errors drawn from P in its own coordinates spread the true position as stated."""
    g = np.random.default_rng(3)
    R_hat, p_hat = Rotation.random(None, g).as_matrix(), np.array([4.0, -7.0, 2.0])
    A = g.normal(size=(6, 6)) * 1e-4
    P = A @ A.T
    errors = g.multivariate_normal(np.zeros(6), P, size=20000)
    turn = Rotation.from_rotvec(errors[:, :3]).as_matrix()
    if coordinates is Coordinates.LEFT:
        R, p = R_hat @ turn, p_hat + errors[:, 3:] @ R_hat.T
    elif coordinates is Coordinates.RIGHT:
        R, p = turn @ R_hat, turn @ p_hat + errors[:, 3:]
    else:
        R = R_hat @ turn
        p = (R @ (R_hat.T @ p_hat + errors[:, 3:])[..., None])[..., 0]
    np.testing.assert_allclose(coordinates.error(R, p, np.broadcast_to(R_hat, R.shape), p_hat), errors, atol=1e-6)
    spread = np.sqrt(np.mean(np.sum((p - p_hat) ** 2, axis=1)))
    assert position_std(P, coordinates, R_hat, p_hat) == pytest.approx(spread, rel=0.02)
