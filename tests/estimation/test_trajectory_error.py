"""Absolute and relative trajectory errors against evo's own figures, SciPy and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from coopenv.estimation.metrics import absolute_error, relative_error

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
