"""Metrics and consistency: errors that are recovered, settling, rates, bounds and intervals."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from coopenv.estimation import metrics, poses
from coopenv.estimation.metrics import (
    absolute_error,
    diverged,
    mean_bounds,
    position_std,
    relative_error,
    wilson_interval,
)
from coopenv.estimation.observability import analyse_observability
from coopenv.estimation.poses import Coordinates
from coopenv.estimation.trajectory import Trajectory
from tests.helpers.synthetic import INITIAL_ERROR, RATE, make_trajectory

unit_vectors = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 1e-2)
angles_deg = st.one_of(
    st.floats(0, 180), st.floats(-12, -1).map(lambda e: 10**e), st.floats(-9, -1).map(lambda e: 180 - 10**e)
)


def rotation(axis: tuple[float, ...], angle_deg: float) -> np.ndarray:
    return Rotation.from_rotvec(np.radians(angle_deg) * np.array(axis) / np.linalg.norm(axis)).as_matrix()


@given(unit_vectors, angles_deg)
def test_quaternion_is_axis_sine_of_half_the_angle(axis: tuple[float, ...], angle: float) -> None:
    q = poses.quaternion_wxyz(rotation(axis, angle))
    half = math.radians(angle) / 2
    expected = np.array([math.cos(half), *(math.sin(half) * np.array(axis) / np.linalg.norm(axis))])
    if angle > 180 - 1e-6:  # q and -q are one rotation, and which one rounding decides
        expected *= np.sign(expected @ q)
    assert_allclose(q, expected, atol=1e-14)
    assert q[0] >= 0


@given(unit_vectors, angles_deg)
def test_orientation_error_is_accurate_at_both_ends(axis: tuple[float, ...], angle: float) -> None:
    error = float(poses.orientation_error_deg(np.eye(3), rotation(axis, angle)))
    assert error == pytest.approx(angle, rel=1e-12, abs=1e-13)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=30)
def test_orientation_error_is_symmetric_and_independent_of_the_frames(seed: int) -> None:
    R, R_hat, Q = Rotation.random(3, np.random.default_rng(seed)).as_matrix()
    error = poses.orientation_error_deg(R, R_hat)
    assert_allclose(poses.orientation_error_deg(R_hat, R), error, atol=1e-10)
    assert_allclose(poses.orientation_error_deg(Q @ R, Q @ R_hat), error, atol=1e-10)
    assert_allclose(poses.orientation_error_deg(R @ Q, R_hat @ Q), error, atol=1e-10)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=30)
def test_roll_pitch_yaw_agrees_with_scipy(seed: int) -> None:
    R = Rotation.random(20, np.random.default_rng(seed))
    assert_allclose(poses.roll_pitch_yaw_deg(R.as_matrix()), R.as_euler("xyz", degrees=True), atol=1e-9)


def test_synthetic_errors_and_nees_are_recovered() -> None:
    run = make_trajectory(ticks=200, noise=0.02, yaw_rate=0.4)
    distance = np.linalg.norm(run.position - run.position_estimate, axis=-1)
    assert_allclose(distance, run.position_error, rtol=1e-10)
    angle = poses.orientation_error_deg(run.rotation, run.rotation_estimate)
    assert_allclose(angle, run.orientation_error, rtol=1e-9)
    error = poses.Coordinates.RICCATI.error(run.rotation, run.position, run.rotation_estimate, run.position_estimate)
    assert_allclose(metrics.nees(error, run.covariance), run.nees, rtol=1e-8)


def test_nees_of_a_consistent_observer_has_the_mean_and_variance_of_chi_square() -> None:
    rng = np.random.default_rng(0)
    root = rng.standard_normal((6, 6))
    errors = rng.standard_normal((40_000, 6)) @ root.T
    values = metrics.nees(errors, np.broadcast_to(root @ root.T, (40_000, 6, 6)))
    assert values.mean() == pytest.approx(6.0, abs=0.1)
    assert values.var() == pytest.approx(12.0, abs=0.6)


def test_nees_is_nan_where_there_is_no_covariance() -> None:
    P = np.stack([np.eye(6), np.zeros((6, 6)), np.full((6, 6), np.nan), -np.eye(6)])
    assert_allclose(metrics.nees(np.ones((4, 6)), P), [6.0, np.nan, np.nan, np.nan])


@pytest.mark.parametrize(
    ("position", "orientation", "expected"),
    [
        ([1, 0.05, 0.05, 0.05], [0, 0, 0, 0], 1.0),
        ([0.05, 0.05, 0.2, 0.05], [0, 0, 0, 0], 3.0),  # a passing visit does not count
        ([0.05, 0.05, 0.05, 0.05], [5, 5, 0.5, 0.5], 2.0),  # both errors must be small
        ([0.05, 0.05, 0.05, 0.1], [0, 0, 0, 0], math.nan),  # the tolerance itself is not below it
        ([0.05, 0.05, math.nan, 0.05], [0, 0, 0, 0], 3.0),
        ([0, 0, 0, 0], [0, 0, 0, 0], 0.0),
    ],
)
def test_settling_time(position: list[float], orientation: list[float], expected: float) -> None:
    t = np.arange(4.0)
    assert_allclose(metrics.settling_time(t, np.array(position), np.array(orientation)), expected)


def test_settling_time_of_an_exponential_in_closed_form() -> None:
    run = make_trajectory()
    settled = metrics.settling_time(run.t, run.position_error, run.orientation_error)
    need_position = np.log(np.linalg.norm(INITIAL_ERROR, axis=-1) / 0.1) / RATE
    need_orientation = np.log(90.0) / RATE
    expected = np.maximum(need_position, need_orientation)
    assert np.all((settled >= expected) & (settled < expected + 1 / 60 + 1e-9))


def test_steady_rmse_counts_only_the_ticks_after_the_burn_in() -> None:
    t, error = np.arange(4.0), np.array([[100.0], [50.0], [3.0], [4.0]])
    assert_allclose(metrics.steady_rmse(t, error, 1.0), [math.sqrt(12.5)])
    assert np.isnan(metrics.steady_rmse(t, error, 10.0)).all()


@given(st.floats(0.05, 5), st.floats(0.1, 100), st.floats(1e-4, 1e-2))
@settings(max_examples=40)
def test_rate_fit_recovers_an_exponential(rate: float, scale: float, floor: float) -> None:
    t = np.linspace(0, 12 / rate, 2000)
    fit = metrics.fit_exponential_rate(t, scale * np.exp(-rate * t), noise_floor=scale * floor)
    assert fit.rate == pytest.approx(rate, rel=1e-9)
    assert fit.low <= fit.rate * (1 + 1e-9) and fit.high >= fit.rate * (1 - 1e-9)


def test_rate_fit_is_robust_and_bounded_by_the_noise_floor() -> None:
    rng = np.random.default_rng(1)
    t = np.linspace(0, 30, 1801)
    descent = 10 * np.exp(-0.8 * t + 0.05 * rng.standard_normal(len(t)))
    error = np.hypot(descent, 0.02 * rng.standard_normal(len(t)))
    error[::17] *= 1.6
    fit = metrics.fit_exponential_rate(t, error)
    assert fit.rate == pytest.approx(0.8, abs=0.02)
    assert 0 < fit.low < fit.rate < fit.high
    assert fit.high - fit.low < 0.06
    last = np.log(10 / (3 * np.median(error[-360:]))) / 0.8  # the noise floor, not the record, ends the fit
    assert fit.samples <= (last - np.log(2) / 0.8 + 1) * 60


def test_rate_fit_starts_after_the_last_excursion() -> None:
    t = np.linspace(0, 40, 2401)
    error = np.where(t < 10, 10.0 + 12.0 * np.sin(t) ** 2, 10.0 * np.exp(-0.5 * (t - 10)))
    assert metrics.fit_exponential_rate(t, error).rate == pytest.approx(0.5, rel=1e-9)


@pytest.mark.parametrize(
    ("error", "remark"),
    [
        (np.append(9.0, np.full(99, 0.01)), "error fell below half within 1 tick"),
        (np.repeat([9.0, 0.01], [40, 60]), "error fell from half to the noise floor within 1 tick"),
        (np.full(100, 4.0), "error ends at 100 % of its initial value"),
        (np.append(1e-15, np.full(99, 3.0)), "error ends above its initial value"),
        (np.append(9.0, np.full(99, 3.0)), "error ends at 33 % of its initial value"),
        (np.append(9.0, np.full(99, np.inf)), "error is not finite"),
        (np.full(100, np.nan), "error is not finite"),
        (np.zeros(100), "no initial error"),
    ],
)
def test_a_missing_rate_is_explained(error: np.ndarray, remark: str) -> None:
    fit = metrics.fit_exponential_rate(np.arange(100.0), error)
    assert np.isnan([fit.rate, fit.low, fit.high]).all() and fit.samples < 10
    assert fit.remark == f"{remark}, no rate to fit"


def test_three_samples_are_enough_for_a_rate() -> None:
    error = np.concatenate([8.0 * np.exp(-1.0 * np.arange(5)), np.full(95, 0.02)])
    fit = metrics.fit_exponential_rate(np.arange(100.0), error)
    assert (fit.samples, fit.remark) == (4, "")
    assert fit.rate == pytest.approx(1.0)
    error = np.concatenate([[8.0, 3.0, 1.0, 0.3], np.full(96, 0.01)])
    assert metrics.fit_exponential_rate(np.arange(100.0), error).samples == 3


def test_noise_that_flickers_above_half_is_no_descent() -> None:
    rng = np.random.default_rng(2)
    t = np.arange(2400) / 60.0
    error = np.where(t < 25, 0.1, 0.01) * np.abs(1 + 0.6 * rng.standard_normal(len(t)))
    error[0] = 0.4
    assert np.flatnonzero(error > 0.2)[-1] > 600
    assert "no rate to fit" in metrics.fit_exponential_rate(t, error).remark


def parked_run() -> tuple[Trajectory, list[float]]:
    """Return the synthetic run with nonsense recorded of vehicle_2 after it ended at 20 s, and all ends."""
    run = make_trajectory()
    after = run.t > 20.0 + 1e-9
    nonsense = {"position_error": 1e6, "orientation_error": 179.0, "nees": np.nan, "visible": False}
    changed = {name: getattr(run, name).copy() for name in nonsense}
    for name, value in nonsense.items():
        changed[name][after, 1] = value
    return replace(run, **changed), [50.0, 20.0, math.nan, 50.0, 50.0]


def test_nothing_counts_after_a_vehicle_has_ended() -> None:
    run, ends = parked_run()
    assert metrics.live_ticks(run.t, 5, ends).tolist() == [3001, 1201, 3001, 3001, 3001]
    assert metrics.live_ticks(run.t, 2).tolist() == [3001, 3001]
    ticks = 1201
    clean = make_trajectory()
    expected = metrics.summarise(make_trajectory(ticks), steady_from=10.0)[1]
    rows = metrics.summarise(run, 10.0, ends)
    assert rows[1] == pytest.approx(expected)
    assert rows[1]["mean_targets_in_view"] == pytest.approx(clean.visible[:ticks, 1].sum() / ticks)
    assert not rows[1]["mirrored"]
    assert rows[0] == pytest.approx(metrics.summarise(clean, 10.0)[0])
    assert math.isnan(metrics.summarise(run, 30.0, ends)[1]["steady_position_rmse_m"])


def test_windows_beyond_the_end_do_not_count() -> None:
    run, ends = parked_run()
    whole = analyse_observability(run)
    cut = metrics.observability_of(whole, 1, ends[1])
    assert cut.vehicles.tolist() == ["vehicle_2"]
    assert cut.t[-1] + cut.window == pytest.approx(20.0)
    assert_allclose(cut.condition_number[:, 0], whole.condition_number[: len(cut.t), 1])
    assert_allclose(cut.local_eigenvalue[:, 0], whole.local_eigenvalue[: len(cut.t), 1])
    assert len(metrics.observability_of(whole, 0, math.nan).t) == len(whole.t)
    assert len(metrics.observability_of(whole, 0, 0.5).t) == 0


def test_summary_of_the_synthetic_run() -> None:
    rows = metrics.summarise(make_trajectory(), steady_from=40.0)
    assert [row["vehicle"] for row in rows] == [f"vehicle_{i}" for i in range(1, 6)]
    assert all(isinstance(value, str | float | bool | int | None) for row in rows for value in row.values())
    for row, initial, rate in zip(rows, np.linalg.norm(INITIAL_ERROR, axis=-1), RATE, strict=True):
        assert row["initial_position_error_m"] == pytest.approx(initial)
        assert row["initial_orientation_error_deg"] == pytest.approx(90.0)
        assert row["rate_per_s"] == pytest.approx(rate, rel=1e-6)
        mean_square = initial**2 * (math.exp(-80 * rate) - math.exp(-100 * rate)) / (2 * rate * 10)
        assert row["steady_position_rmse_m"] == pytest.approx(math.sqrt(mean_square), rel=0.02)
        assert row["steady_orientation_rmse_deg"] == pytest.approx(90 / initial * math.sqrt(mean_square), rel=0.02)
        assert row["final_position_error_m"] == pytest.approx(initial * math.exp(-50 * rate))
        assert row["mirrored"] is False
    assert rows[3]["mean_targets_in_view"] == pytest.approx(3 - np.mean(np.sin(3 * np.arange(3001) / 60) > 0.97))


def test_mirror_is_detected_by_the_end_of_the_run() -> None:
    errors = np.array([[179.0, 10.0, 0.0], [2.0, 178.0, 149.0]])
    assert metrics.mirrored(errors).tolist() == [False, True, False]


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


def test_a_run_diverges_that_ends_above_a_limit_or_exceeds_it_again() -> None:
    """Ends below; above in position, in orientation; unknown; a late start; an excursion; unknown at its end."""
    last = np.array([[4.9, 5.1, 1.0, np.nan], [29.0, 1.0, 31.0, 1.0]])
    assert diverged(last[0][None], last[1][None]).tolist() == [False, True, True, True]
    position = np.array([[11.0, 33.0, 1.0, 0.1], [0.8, 25.0, 1.0, 0.1], [0.8, 1.0, 1.0, np.nan]]).T
    assert diverged(position, np.ones_like(position)).tolist() == [False, True, False]


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
