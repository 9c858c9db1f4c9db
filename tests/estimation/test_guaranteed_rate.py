"""The rates of the theory against an ODE solver in body frames, and against errors that really fall."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp
from scipy.linalg import eigvals

from coopenv.estimation.observability import Trajectory, convergence_rates, least_mean, slowest_decay
from coopenv.runs.rollouts import rollout
from coopenv.scenario import load_scenario
from tests.helpers.synthetic import make_trajectory
from tests.oracles.continuous import skew

YAW_RATE, V, P0 = 0.7, (0.1, 1.0), (1.0, 100.0)
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


def solved(run: Trajectory, vehicle: int, until: float, k: float) -> tuple[np.ndarray, np.ndarray]:
    """Integrate P and the transition X of the linearised error x' = (A - k P M) x up to a time."""

    def flow(t: float, y: np.ndarray) -> np.ndarray:
        P, X = y[:36].reshape(6, 6), y[36:].reshape(6, 6)
        A, M = matrices(run, vehicle, t)
        growth = A @ P + P @ A.T - P @ M @ P + np.diag(np.repeat(V, 3))
        return np.concatenate([growth.ravel(), ((A - k * P @ M) @ X).ravel()])

    start = np.concatenate([np.diag(np.repeat(P0, 3)).ravel(), np.eye(6).ravel()])
    end = solve_ivp(flow, (0.0, until), start, method="LSODA", rtol=1e-6, atol=1e-9, max_step=run.t[1]).y[:, -1]
    return end[:36].reshape(6, 6), end[36:].reshape(6, 6)


@pytest.mark.parametrize(("vehicle", "k"), [(0, 1.0), (3, 0.8)])
def test_rates_are_those_of_the_differential_equations(vehicle: int, k: float) -> None:
    run = make_trajectory(ticks=121, yaw_rate=YAW_RATE)
    rates = convergence_rates(run, [k] * 5, Q, V, P0)
    for until in (1.0, 2.0):
        n = round(until / run.t[1])
        P, _ = solved(run, vehicle, until, k)
        _, M = matrices(run, vehicle, until)
        assert_allclose(rates.frozen[n, vehicle], k * eigvals(P @ M).real.min(), rtol=0.02)
        inverse = np.linalg.inv(P)
        mixed = P @ ((k - 0.5) * M + 0.5 * inverse @ np.diag(np.repeat(V, 3)) @ inverse)
        assert_allclose(rates.guaranteed[n, vehicle], eigvals(mixed).real.min(), rtol=0.02)


@pytest.mark.parametrize(("vehicle", "k"), [(0, 1.0), (3, 0.8)])
def test_no_error_falls_more_slowly_than_guaranteed(vehicle: int, k: float) -> None:
    """In the norm of P^-1, from every direction: the worst ratio of norms is the largest singular value."""
    run = make_trajectory(ticks=121, yaw_rate=YAW_RATE)
    rates = convergence_rates(run, [k] * 5, Q, V, P0)
    (P_early, X_early), (P_late, X_late) = (solved(run, vehicle, until, k) for until in (0.5, 2.0))
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
