"""Observability from Gramians, and the rate that it guarantees."""

from __future__ import annotations

import dataclasses
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp
from scipy.linalg import eigvals
from scipy.spatial.transform import Rotation

from coopenv.estimation import Sight
from coopenv.estimation.observability import analyse_observability, convergence_rates, least_mean, slowest_decay
from coopenv.estimation.trajectory import Trajectory
from coopenv.observers.bound import relative_information
from coopenv.runs.recorder import record_episode
from coopenv.runs.rollouts import rollout
from coopenv.scenario import load_scenario, parse_scenario
from tests.helpers.builders import circling, raw
from tests.helpers.env_suite import rest_slow
from tests.helpers.synthetic import LANDMARKS, NEIGHBOURS, START, VELOCITY, make_trajectory
from tests.oracles.continuous import skew

YAW_RATE = 0.7


def scene(position: np.ndarray, targets: np.ndarray, ticks: int = 61) -> Trajectory:
    """Return one vehicle along `position` (K, 3), or at rest (3,), that sees all fixed `targets` (T, 3)."""
    run = make_trajectory(ticks)
    path = np.broadcast_to(position, (ticks, 3))[:, None]
    seen = np.ones((ticks, 1, len(targets)), bool)
    return dataclasses.replace(
        run.of_vehicles([0]),
        position=path,
        visible=seen,
        sight=np.where(seen, Sight.VISIBLE, 0),
        target_position=np.broadcast_to(targets, (ticks, *targets.shape)),
        targets=np.array([f"landmark_{i}" for i in range(len(targets))]),
        target_moving=np.zeros(len(targets), bool),
    )


def shifted(run: Trajectory, offset: np.ndarray) -> Trajectory:
    return dataclasses.replace(run, position=run.position + offset, target_position=run.target_position + offset)


def local_eigenvalue(position: np.ndarray, targets: np.ndarray) -> float:
    return float(analyse_observability(scene(position, targets)).local_eigenvalue[0, 0])


def reference_gramian(vehicle: int, start: float, window: float) -> np.ndarray:
    """Integrate Phi' = A Phi and W' = Phi^T C*^T C* Phi with the body-frame formulas of the theorem."""
    A = np.zeros((6, 6))
    A[:3, :3] = A[3:, 3:] = -skew(np.array([0, 0, YAW_RATE]))

    def target(j: int, t: float) -> np.ndarray:
        return LANDMARKS[j] if j < 3 else START[j - 3] + VELOCITY[j - 3] * t

    def flow(t: float, state: np.ndarray) -> np.ndarray:
        Phi = state[:36].reshape(6, 6)
        R = Rotation.from_euler("z", YAW_RATE * t).as_matrix()
        information = np.zeros((6, 6))
        for j in NEIGHBOURS[vehicle]:
            z, p = R.T @ target(j, t), R.T @ target(vehicle + 3, t)
            g = (p - z) / np.linalg.norm(p - z)
            Pi = np.eye(3) - np.outer(g, g)
            C = np.hstack([-Pi @ skew(z), Pi])
            information += C.T @ C
        return np.concatenate([(A @ Phi).ravel(), (Phi.T @ information @ Phi).ravel()])

    begin = np.concatenate([np.eye(6).ravel(), np.zeros(36)])
    solution = solve_ivp(flow, (start, start + window), begin, rtol=1e-11, atol=1e-11, method="DOP853")
    return solution.y[36:, -1].reshape(6, 6) / window


@pytest.mark.parametrize("vehicle", [0, 1, 3])
def test_gramian_agrees_with_an_ode_solver_while_the_body_turns(vehicle: int) -> None:
    run = make_trajectory(ticks=121, yaw_rate=YAW_RATE)
    run = dataclasses.replace(run, visible=run.sight != Sight.NOT_A_NEIGHBOUR)
    result = analyse_observability(run, window=1.0)
    assert len(result.t) == 61
    for k in (0, 30, 60):
        eigenvalues = np.linalg.eigvalsh(reference_gramian(vehicle, result.t[k], 1.0))
        assert result.min_eigenvalue[k, vehicle] == pytest.approx(eigenvalues[0], rel=1e-3)
        assert result.condition_number[k, vehicle] == pytest.approx(eigenvalues[-1] / eigenvalues[0], rel=1e-3)


def test_gramian_agrees_with_the_notes_on_the_busy_intersection() -> None:
    """The instantaneous condition number of f1 at the start, computed independently beforehand, is 1.9e3."""
    result = analyse_observability(make_trajectory(ticks=10), window=1 / 60)
    assert result.condition_number[0, 0] == pytest.approx(1.9e3, rel=0.05)


def test_switching_visibility_is_integrated_over_time() -> None:
    """Targets seen during half of the window weigh half: the trapezoid across the switch, tick by tick."""
    run = scene(np.zeros(3), LANDMARKS)
    half = dataclasses.replace(run, visible=run.visible & (np.arange(61)[:, None, None] < 30))
    whole, part = analyse_observability(run), analyse_observability(half)
    assert_allclose(part.min_eigenvalue[0], whole.min_eigenvalue[0] * 29.5 / 60, rtol=1e-9)
    assert_allclose(part.condition_number[0], whole.condition_number[0], rtol=1e-9)


@pytest.mark.parametrize(
    ("targets", "reason"),
    [
        (LANDMARKS[:2], "turning everything about the line through two targets changes no bearing"),
        (np.array([[4.0, k, 2 * k] for k in range(4)]), "so it is with any number on one line"),
        (np.empty((0, 3)), "nothing is seen"),
    ],
)
def test_degenerate_targets_are_not_observable_even_in_motion(targets: np.ndarray, reason: str) -> None:
    path = np.array([-10.0, -3, 1]) + np.linspace(0, 1, 61)[:, None] * np.array([3.0, 1, 0.5])
    result = analyse_observability(scene(path, targets))
    assert result.local_eigenvalue.max() < 1e-12, reason
    assert not result.observable.any()
    assert result.condition_number.min() > 1e12


@given(st.floats(0, 2 * np.pi), st.floats(-8, 8), st.floats(2, 12))
@settings(max_examples=30, deadline=None)
def test_danger_cylinder_is_singular_at_rest_and_not_off_it(angle: float, height: float, radius: float) -> None:
    """Three targets on a circle: singular exactly on the cylinder through it, not inside of it."""
    targets = radius * np.array([[np.cos(a), np.sin(a), 0] for a in (0.0, 2.1, 4.2)])
    on = np.array([radius * np.cos(angle), radius * np.sin(angle), height])
    if np.linalg.norm(targets - on, axis=-1).min() < 0.3 * radius:
        return  # beside a target every other smallness is small too
    assert local_eigenvalue(on, targets) < 1e-12
    assert local_eigenvalue(on * [0.2, 0.2, 0] + [0, 0, 1.5 * radius], targets) > 1e-3


@given(st.tuples(*[st.floats(-2000, 2000)] * 3))
@settings(max_examples=15, deadline=None)
def test_verdict_does_not_depend_on_the_map_origin(offset: tuple[float, float, float]) -> None:
    run = make_trajectory(ticks=121)
    near, far = analyse_observability(run), analyse_observability(shifted(run, np.array(offset)))
    assert_allclose(far.local_eigenvalue, near.local_eigenvalue, rtol=1e-5, atol=1e-11)


def test_theorems_eigenvalue_falls_with_the_square_of_the_distance_to_the_origin() -> None:
    run = make_trajectory(ticks=61)
    at = [analyse_observability(shifted(run, np.array([d, d, 0.0]))).min_eigenvalue[0] for d in (1e3, 2e3)]
    assert_allclose(at[0] / at[1], 4.0, rtol=0.05)


@given(st.floats(0.01, 1000))
@settings(max_examples=20, deadline=None)
def test_local_eigenvalue_has_no_unit(scale: float) -> None:
    position = np.array([-3.0, -9, 1])
    assert local_eigenvalue(scale * position, scale * LANDMARKS) == pytest.approx(
        local_eigenvalue(position, LANDMARKS), rel=1e-9
    )


def test_threshold_is_the_accuracy_it_is_argued_to_be() -> None:
    """L sigma / sqrt(n mu) is the worst standard deviation that least squares leaves, by Monte Carlo."""
    run = scene(np.array([-17.0, 2, 3]), LANDMARKS)
    mu = float(analyse_observability(run).local_eigenvalue[0, 0])
    offsets = LANDMARKS - run.position[0, 0]
    distance = np.linalg.norm(offsets, axis=-1)
    length, sigma, ticks = np.sqrt(np.mean(distance**2)), 3e-3, 60
    rows = []
    for offset, d in zip(offsets, distance, strict=True):
        Pi = np.eye(3) - np.outer(offset, offset) / d**2
        rows.append(np.hstack([-Pi @ skew(offset) / length, Pi]))
    C = np.vstack(rows)
    rng = np.random.default_rng(0)
    noise = length * sigma / np.sqrt(ticks) * rng.standard_normal((4000, len(C)))
    estimates = noise @ np.linalg.pinv(C).T
    worst = np.sqrt(np.linalg.eigvalsh(np.cov(estimates.T))[-1])
    assert worst == pytest.approx(length * sigma / np.sqrt(ticks * mu), rel=0.05)


def test_intervals_tile_the_record_and_follow_visibility() -> None:
    result = analyse_observability(make_trajectory())
    for vehicle in range(5):
        intervals = result.intervals(vehicle)
        assert intervals[0].start == 0.0 and intervals[-1].end == pytest.approx(50.0)
        for before, after in pairwise(intervals):
            assert before.end == after.start and before.observable != after.observable
    first, second, *_ = (result.intervals(v) for v in range(5))
    assert [i.observable for i in first] == [True, False]  # one of three landmarks is lost at 38 s for good
    assert first[1].start == pytest.approx(38.0, abs=0.1)
    assert [i.observable for i in second] == [True, False, True]
    assert (second[1].start, second[1].end) == pytest.approx((12.0, 17.0), abs=0.1)  # windows reach 1 s ahead


@pytest.mark.parametrize("ticks", [1, 2, 30])
def test_short_records_give_one_window_or_none(ticks: int) -> None:
    result = analyse_observability(make_trajectory(ticks=ticks))
    assert len(result.t) == (1 if ticks > 1 else 0)
    assert len(result.intervals(0)) == len(result.t)
    assert result.window == pytest.approx((ticks - 1) / 60)


def test_uneven_ticks_weigh_by_their_duration() -> None:
    even = make_trajectory(ticks=121)
    keep = np.sort(np.random.default_rng(2).permutation(np.arange(1, 120))[:90])
    keep = np.concatenate([[0], keep, [120]])
    gaps = even.position.copy()
    gaps[np.setdiff1d(np.arange(121), keep)] = np.nan
    uneven = dataclasses.replace(even, position=gaps).where_truth_is_known()
    result, expected = analyse_observability(uneven, 2.0), analyse_observability(even, 2.0)
    for vehicle in (0, 1, 2):  # whose visibility does not switch in this time
        for name in ("min_eigenvalue", "condition_number", "local_eigenvalue"):
            assert getattr(result, name)[0, vehicle] == pytest.approx(getattr(expected, name)[0, vehicle], rel=1e-3)


V, P0 = (0.1, 1.0), (1.0, 100.0)
Q = np.linspace(5.0, 12.0, 8)


def matrices(run: Trajectory, vehicle: int, t: float) -> tuple[np.ndarray, np.ndarray]:
    """Return A and M at a time as the paper writes them, in the body frame; the bearings of a tick are held."""
    n = min(int(np.ceil(t / run.t[1] - 1e-9)), len(run.t) - 1)
    R, A, M = run.rotation[n, vehicle], np.zeros((6, 6)), np.zeros((6, 6))
    A[:3, :3] = A[3:, 3:] = -skew(np.array([0.0, 0.0, YAW_RATE]))
    for j in np.flatnonzero(run.visible[n, vehicle]):
        d = R.T @ (run.target_position[n, j] - run.position[n, vehicle])
        across = np.eye(3) - np.outer(d, d) / (d @ d)
        C = across @ np.hstack([-skew(R.T @ run.target_position[n, j]), np.eye(3)])
        M += Q[j] * C.T @ C
    return A, M


def solved(run: Trajectory, vehicle: int, times: tuple[float, float], k: float) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return P and the transition X of the linearised error x' = (A - k P M) x at some times."""

    def flow(t: float, y: np.ndarray) -> np.ndarray:
        P, X = y[:36].reshape(6, 6), y[36:].reshape(6, 6)
        A, M = matrices(run, vehicle, t)
        growth = A @ P + P @ A.T - P @ M @ P + np.diag(np.repeat(V, 3))
        return np.concatenate([growth.ravel(), ((A - k * P @ M) @ X).ravel()])

    start = np.concatenate([np.diag(np.repeat(P0, 3)).ravel(), np.eye(6).ravel()])
    step = run.t[1]
    found = solve_ivp(flow, (0.0, times[-1]), start, "LSODA", times, rtol=1e-6, atol=1e-9, max_step=step).y.T
    return [(end[:36].reshape(6, 6), end[36:].reshape(6, 6)) for end in found]


@pytest.mark.parametrize(("vehicle", "k"), rest_slow([(0, 1.0), (3, 0.8)], 1))
def test_rates_are_those_of_the_differential_equations(vehicle: int, k: float) -> None:
    run = make_trajectory(ticks=121, yaw_rate=YAW_RATE)
    rates = convergence_rates(run, [k] * 5, Q, V, P0)
    times = (1.0, 2.0)
    for until, (P, _) in zip(times, solved(run, vehicle, times, k), strict=True):
        n = round(until / run.t[1])
        _, M = matrices(run, vehicle, until)
        assert_allclose(rates.frozen[n, vehicle], k * eigvals(P @ M).real.min(), rtol=0.02)
        inverse = np.linalg.inv(P)
        mixed = P @ ((k - 0.5) * M + 0.5 * inverse @ np.diag(np.repeat(V, 3)) @ inverse)
        assert_allclose(rates.guaranteed[n, vehicle], eigvals(mixed).real.min(), rtol=0.02)


@pytest.mark.parametrize(("vehicle", "k"), rest_slow([(0, 1.0), (3, 0.8)], 0))
def test_no_error_falls_more_slowly_than_guaranteed(vehicle: int, k: float) -> None:
    """In the norm of P^-1, from every direction: the worst ratio of norms is the largest singular value."""
    run = make_trajectory(ticks=121, yaw_rate=YAW_RATE)
    rates = convergence_rates(run, [k] * 5, Q, V, P0)
    (P_early, X_early), (P_late, X_late) = solved(run, vehicle, (0.5, 2.0), k)
    between = X_late @ np.linalg.inv(X_early)
    shrunk = np.linalg.solve(np.linalg.cholesky(P_late), between @ np.linalg.cholesky(P_early))
    worst = np.linalg.svd(shrunk, compute_uv=False)[0]
    promised = np.exp(-np.trapezoid(rates.guaranteed[30:121, vehicle], run.t[30:121]))
    assert 0.3 * promised < worst < promised * 1.02
    frozen = np.exp(-np.trapezoid(rates.frozen[30:121, vehicle], run.t[30:121]))
    assert frozen != pytest.approx(promised, rel=0.02)


def test_figures_that_others_computed() -> None:
    """lambda_min(P M) of f1, f2 and f5 of the busy intersection every 5 s, by a reviewer's own program."""
    scenario = load_scenario("busy_intersection", {"noise.enabled": False, "horizon": 31.0})
    run, observer = rollout(scenario), scenario.observer
    rates = convergence_rates(run, [1.0] * 5, np.full(8, 10.0), observer.V, observer.P0)
    at = [300 * n for n in range(1, 7)]
    assert_allclose(rates.frozen[at, 0], [0.87, 0.86, 0.48, 0.18, 1.08, 1.56], atol=0.006)
    assert_allclose(rates.frozen[at, 1], [0.60, 0.77, 1.01, 1.33, 1.57, 0.71], atol=0.006)
    assert_allclose(rates.frozen[at, 4], [0.09, 0.14, 0.20, 0.29, 0.46, 0.93], atol=0.006)
    slowest, start = slowest_decay(run.t, run.position_error[:, 4])
    assert slowest == pytest.approx(0.03, abs=0.005) and start == 5.0
    assert rates.guaranteed[:, 4].min() == pytest.approx(0.0293, rel=0.01)


def test_without_bearings_nothing_is_promised_for_long() -> None:
    """P grows by V t alone: the guaranteed rate is half the least eigenvalue of V P^-1, the frozen one 0."""
    run = make_trajectory(ticks=61)
    blind = type(run)(**{**vars(run), "visible": np.zeros_like(run.visible)})
    rates = convergence_rates(blind, [1.0] * 5, Q, V, P0)
    assert not rates.frozen.any()
    expected = 0.5 * np.minimum(V[0] / (P0[0] + V[0] * run.t), V[1] / (P0[1] + V[1] * run.t))
    assert_allclose(rates.guaranteed, np.repeat(expected[:, None], 5, axis=1), rtol=1e-12)


def test_the_slowest_window_is_found_and_noise_is_none() -> None:
    t = np.arange(0.0, 40.0, 0.1)
    rate = np.where(t < 10.0, 1.0, np.where(t < 15.0, 0.2, 0.8))
    error = np.exp(-np.concatenate([[0.0], np.cumsum(0.1 * rate[:-1])]))
    assert slowest_decay(t, error) == (pytest.approx(0.2, rel=0.02), pytest.approx(10.0))
    assert slowest_decay(t, np.maximum(error, 1e-3))[1] == 0.0  # at 15 s the noise is reached
    assert np.isnan(slowest_decay(t, np.full(len(t), 0.02))).all()


def test_the_least_mean_of_a_ramp() -> None:
    t = np.arange(0.0, 20.0, 0.25)
    mean, start = least_mean(t, 30.0 - t)
    assert start == pytest.approx(14.75) and mean == pytest.approx(30.0 - 14.75 - 2.5)
    assert np.isnan(least_mean(t[:5], t[:5])).all()


def test_a_sensor_of_bearings_counts_as_the_camera_does() -> None:
    """It sits at the origin of the body and has the noise of the camera."""
    bearing = {"model": "isotropic", "scale": 0.01, "rate": 60.0}
    sensor = {"kind": "bearing", "towards": ["landmarks", "vehicles"], "noise": 0.01}
    given = {"noise": {"bearing": bearing}, "horizon": 1.5, "observer": {"name": "dead_reckoning"}}
    seen, silent = (
        record_episode(parse_scenario(raw(circling(), sensors=[sensor], camera=camera, **given), "test"))
        for camera in ({"orientation": "body"}, {"model": "none"})
    )
    more = relative_information(silent.measured)
    found = analyse_observability(silent.trajectory, more=more)
    expected = analyse_observability(seen.trajectory)
    for name in ("min_eigenvalue", "local_eigenvalue"):
        assert_allclose(getattr(found, name), getattr(expected, name), rtol=1e-6, atol=1e-12)
    assert not analyse_observability(silent.trajectory).local_eigenvalue.any()
