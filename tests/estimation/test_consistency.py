"""Consistency measures, and absolute and relative trajectory errors, against SciPy, evo and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from coopenv.estimation.metrics import (
    absolute_error,
    diverged,
    mean_bounds,
    position_std,
    relative_error,
    wilson_interval,
)
from coopenv.estimation.poses import Coordinates


def test_bounds_of_a_reference() -> None:
    """20 runs of 6 degrees of freedom: 0.76 .. 1.27."""
    assert mean_bounds(6, 20) == pytest.approx((0.763, 1.268), abs=1e-3)


def test_bounds_hold_what_they_promise() -> None:
    low, high = mean_bounds(3, 8)
    means = np.random.default_rng(0).chisquare(3, size=(4000, 8)).mean(axis=1) / 3
    assert np.mean((means > low) & (means < high)) == pytest.approx(0.95, abs=0.015)


def test_interval_of_a_share() -> None:
    assert wilson_interval(3, 10) == pytest.approx((0.1078, 0.6032), abs=1e-4)
    assert wilson_interval(0, 0) == (0.0, 1.0)  # nothing is known without trials


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


Path = tuple[np.ndarray, np.ndarray]


def paths() -> tuple[Path, Path]:
    """Return a true and an estimated path of 500 poses."""
    g = np.random.default_rng(1)
    R = Rotation.from_rotvec(np.cumsum(g.normal(size=(500, 3)) * 0.03, 0)).as_matrix()
    p = np.cumsum(g.normal(size=(500, 3)), 0)
    R_hat = R @ Rotation.from_rotvec(g.normal(size=(500, 3)) * 0.2).as_matrix()
    turn = Rotation.from_rotvec([0.3, 0.2, 1.0]).as_matrix()
    return (R, p), (R_hat, p @ turn.T + np.array([5, 2, 1]) + g.normal(size=(500, 3)))


def test_evo_s_figures() -> None:
    """As evo 1.38.1 gives them for these paths: APE, and RPE over 7 frames."""
    (R, p), (R_hat, p_hat) = paths()
    assert absolute_error(p, p_hat) == pytest.approx(17.621529806694294, rel=1e-9)
    assert relative_error(R, p, R_hat, p_hat, 7) == pytest.approx((4.392742811945746, 28.448216086288816), rel=1e-9)


def test_a_constant_frame_has_no_relative_error() -> None:
    (R, p), _ = paths()
    turn = Rotation.from_rotvec([0.1, -0.4, 2.0]).as_matrix()
    moved = turn @ R, p @ turn.T + [3.0, 1.0, -2.0]
    assert relative_error(R, p, *moved, 5) == pytest.approx((0.0, 0.0), abs=1e-6)
    assert absolute_error(p, moved[1]) > 1.0


def test_a_drift_per_second() -> None:
    """An estimate that goes 1 % too far is off by 1 % of the way between the poses of each pair."""
    R, p = np.broadcast_to(np.eye(3), (101, 3, 3)), np.outer(np.arange(101.0), [1.0, 0.0, 0.0])
    assert relative_error(R, p, R, 1.01 * p, 10).position == pytest.approx(0.1)


def test_unknown_truth_is_left_out() -> None:
    (R, p), (R_hat, p_hat) = paths()
    gone_p, gone_R = p.copy(), R.copy()
    gone_p[100:200], gone_R[100:200] = np.nan, np.nan
    rest = np.r_[0:100, 200:500]
    assert absolute_error(gone_p, p_hat) == pytest.approx(absolute_error(p[rest], p_hat[rest]))
    assert np.isfinite(relative_error(gone_R, gone_p, R_hat, p_hat, 7)).all()
    nothing = np.full_like(p, np.nan)
    assert np.isnan(absolute_error(nothing, p_hat)) and np.isnan(relative_error(R, nothing, R_hat, p_hat, 7)).all()
    assert np.isnan(relative_error(R[:3], p[:3], R[:3], p[:3], 7)).all()
