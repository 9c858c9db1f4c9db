"""The equations of the paper's observer, and the gradient through its kernels."""

from __future__ import annotations

import decimal
from typing import Any

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import coopenv
from coopenv.base.seeds import world_keys
from coopenv.estimation import linalg
from coopenv.observers import riccati as kernels
from coopenv.scenario import Scenario
from examples.differentiable import DifferentiableWorld, check_differentiable, tick_intervals
from tests.helpers.builders import simulate
from tests.helpers.four_way import FOUR_WAY
from tests.helpers.warp_calls import Calls
from tests.oracles.continuous import skew


@wp.func
def blocks(M: Any):
    return linalg.block3(M, 0, 0), linalg.block3(M, 0, 3), linalg.block3(M, 3, 3)


@wp.func
def joined(A: Any, B: Any, D: Any):
    return linalg.join6(A, B, wp.transpose(B), D)


@wp.func
def predicted(E: Any, P: Any, v1: Any, v2: Any):
    A, B, D = blocks(P)
    A, B, D = kernels.predict_covariance(E, A, B, D, v1, v2)
    return joined(A, B, D)


@wp.func
def information(a: Any, b: Any, e: Any, q: Any):
    r = type(e)()
    o = wp.matrix(dtype=e.dtype, shape=(3, 3))
    M11, M12, M22, r1, r2 = kernels.accumulate_information(a, b, e, q, o, o, o, r, r)
    return joined(M11, M12, M22), r1, r2


@wp.func
def kalman(h: Any, P: Any, M: Any, r1: Any, r2: Any):
    """Correct with k = 1."""
    M11, M12, M22 = blocks(M)
    A, B, D = blocks(P)
    L11, L21, L22, _I11, _I22 = linalg.cholesky6(A, B, D)
    dx1, dx2, A, B, D = kernels.correct_kalman(h, M11, M12, M22, L11, L21, L22, r1, r2)
    return dx1, dx2, joined(A, B, D)


@wp.func
def modal(k: Any, h: Any, P: Any, M: Any, r1: Any, r2: Any):
    """Correct with any other gain."""
    M11, M12, M22 = blocks(M)
    A, B, D = blocks(P)
    L11, L21, L22, _I11, _I22 = linalg.cholesky6(A, B, D)
    T, spectrum = kernels.correction_modes(M11, M12, M22, L11, L21, L22)
    dx1, dx2 = kernels.correct_modes(k, h, T, spectrum, r1, r2)
    return dx1, dx2, kernels.covariance_modes(h, T, spectrum)


call = Calls(
    __name__,
    {kernels.gain_factor: "1 1 1 > 1", kalman: "1 66 66 3 3 > 3 3 66", modal: "1 1 66 66 3 3 > 3 3 66"},
    {predicted: "33 66 1 1 > 66", information: "3 3 3 1 > 66 3 3"},
)
GAINS = (0.51, 0.6, 1.0, 2.5, 5.0, 80.0, 1000.0)


def covariance(seed: int, scale: float = 1.0) -> np.ndarray:
    A = np.random.default_rng(seed).normal(size=(6, 6))
    D = np.diag([1.0, 1.0, 1.0, 3.0, 3.0, 3.0])
    P = scale * D @ (A @ A.T + 0.2 * np.eye(6)) @ D
    return (P + P.T) / 2


def output_matrix(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return C_ij = [-Pi_g S(Rhat^T zhat), Pi_g] (3, 6), as the paper defines it."""
    Pi = np.eye(3) - np.outer(b, b)
    return np.hstack([-Pi @ skew(a), Pi])


def view(seed: int, count: int = 4) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return targets a, unit bearings b and innovations e = a - c - phat, in the body frame."""
    rng = np.random.default_rng(seed)
    a, b, p = rng.uniform(-5, 5, (count, 3)), rng.normal(size=(count, 3)), rng.normal(size=3)
    return a, b / np.linalg.norm(b, axis=1, keepdims=True), a - p


def total_information(seed: int, q: float = 10.0, count: int = 4) -> tuple[np.ndarray, np.ndarray]:
    M, r = np.zeros((6, 6)), np.zeros(6)
    for a, b, e in zip(*view(seed, count), strict=True):
        C = output_matrix(a, b)
        M += q * C.T @ C
        r += q * C.T @ (np.eye(3) - np.outer(b, b)) @ e
    return (M + M.T) / 2, r


@given(st.integers(0, 10**6), st.floats(0.01, 1000.0))
@settings(max_examples=60, deadline=None)
def test_information_is_c_transposed_q_c(seed: int, q: float) -> None:
    a, b, e = view(seed)
    M, r1, r2 = call(information, "float64", a, b, e, np.full(len(a), q))
    for i in range(len(a)):
        C = output_matrix(a[i], b[i])
        assert_allclose(M[i], q * C.T @ C, atol=1e-12 * q * 100)
        innovation = (np.eye(3) - np.outer(b[i], b[i])) @ e[i]
        assert_allclose(np.concatenate([r1[i], r2[i]]), q * C.T @ innovation, atol=1e-12 * q * 100)


def test_prediction_solves_the_lyapunov_equation() -> None:
    """dP/dt = A P + P A^T + V with A = blkdiag(-S(omega), -S(omega)), by an ODE solver."""
    P0, omega, h = covariance(1), np.array([0.4, -0.8, 1.3]), 0.37
    A = np.kron(np.eye(2), -skew(omega))
    V = np.diag([0.1] * 3 + [1.0] * 3)

    def rate(_: float, y: np.ndarray) -> np.ndarray:
        P = y.reshape(6, 6)
        return (A @ P + P @ A.T + V).ravel()

    exact = solve_ivp(rate, (0, h), P0.ravel(), rtol=1e-12, atol=1e-12).y[:, -1].reshape(6, 6)
    E = Rotation.from_rotvec(-omega * h).as_matrix()
    P = call(predicted, "float64", E[None], P0[None], [0.1 * h], [1.0 * h])[0]
    assert_allclose(P, exact, atol=1e-10)
    assert (P == P.T).all()


def exact_gain(k: float, m: float, h: float) -> float:
    with decimal.localcontext(prec=80):
        K, M, H = (decimal.Decimal(x) for x in (k, m, h))
        return float(K * H if M == 0 else (1 - (1 + M * H) ** -K) / M)


@pytest.mark.parametrize(("dtype", "tolerance"), [("float64", 3e-12), ("float32", 2e-3)])
def test_gain_factor_to_all_orders(dtype: str, tolerance: float) -> None:
    """Series take over for small m h and small k log(1 + m h); the borders are among the samples."""
    around = [1e-4 * (1 - 1e-6), 1e-4 * (1 + 1e-6), 1e-3 * (1 - 1e-6), 1e-3 * (1 + 1e-6), 0.0]
    growth = np.concatenate([np.logspace(-36, 6, 127), around])
    h = 1.0 / 64.0
    for k in GAINS:
        values = call(kernels.gain_factor, dtype, np.full(len(growth), k), growth / h, np.full(len(growth), h))
        m = (growth / h).astype(dtype).astype(float)
        held = float(np.dtype(dtype).type(k))
        assert_allclose(values, [exact_gain(held, x, h) for x in m], rtol=tolerance)


def corrected(
    k: float, h: float, P: np.ndarray, M: np.ndarray, r: np.ndarray, dtype: str = "float64"
) -> tuple[np.ndarray, np.ndarray]:
    """Return (dx (6,), P+ (6, 6)) of one correction."""
    given = ([h], P[None], M[None], r[None, :3], r[None, 3:])
    if k == 1.0:
        dx1, dx2, after = call(kalman, dtype, *given)
    else:
        dx1, dx2, after = call(modal, dtype, [k], *given)
    return np.concatenate([dx1[0], dx2[0]]), after[0]


@pytest.mark.parametrize("k", GAINS)
@pytest.mark.parametrize("targets", [1, 2, 4])
def test_correction_is_the_frozen_flow(k: float, targets: int) -> None:
    """d dx/dt = k P (r - M dx), dP/dt = -P M P over h, by an ODE solver."""
    P0 = covariance(2, scale=0.05)
    M, r = total_information(3, q=10.0, count=targets)
    h = 1.0 / 60.0

    def rate(_: float, y: np.ndarray) -> np.ndarray:
        P = y[6:].reshape(6, 6)
        return np.concatenate([k * P @ (r - M @ y[:6]), (-P @ M @ P).ravel()])

    start = np.concatenate([np.zeros(6), P0.ravel()])
    end = solve_ivp(rate, (0, h), start, method="LSODA", rtol=1e-11, atol=1e-13).y[:, -1]
    dx, P = corrected(k, h, P0, M, r)
    assert_allclose(dx, end[:6], atol=1e-7)
    assert_allclose(P, end[6:].reshape(6, 6), atol=1e-7)


@pytest.mark.parametrize("k", GAINS)
def test_correction_never_overshoots(k: float) -> None:
    """Each mode moves by (1 - (1 + m h)^-k) of the way, so the residual shrinks whatever k and h."""
    M, r = total_information(7, q=25.0)
    target = np.linalg.solve(M, r)
    for h in (1e-3, 1.0 / 60.0, 1.0, 100.0):
        P = covariance(8)
        dx, after = corrected(k, h, P, M, r)
        weight = np.linalg.inv(P)
        before = target @ weight @ target
        left = (target - dx) @ weight @ (target - dx)
        assert left <= before * (1 + 1e-9)
        assert np.linalg.eigvalsh(after).min() > 0.0
        assert np.linalg.eigvalsh(P - after).min() > -1e-9


@pytest.mark.parametrize("k", [1.0, 80.0])
def test_no_information_changes_nothing(k: float) -> None:
    P = covariance(9)
    dx, after = corrected(k, 0.1, P, np.zeros((6, 6)), np.zeros(6))
    assert (dx == 0.0).all()
    assert_allclose(after, P, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize(("dtype", "spread"), [("float64", 14), ("float32", 8)])
@pytest.mark.parametrize("k", [0.6, 1.0, 80.0])
def test_covariance_stays_definite_in_extreme_units(k: float, dtype: str, spread: int) -> None:
    """P of `spread` decades against a strong, nearly singular M."""
    rng = np.random.default_rng(10)
    for _ in range(20):
        scale = 10.0 ** (spread / 2 * rng.uniform(-0.5, 0.5, 6))
        P = covariance(int(rng.integers(1000))) * scale[:, None] * scale
        M, r = total_information(int(rng.integers(1000)), q=100.0, count=1)
        dx, after = corrected(k, 1 / 60, P, M, r, dtype)
        assert np.isfinite(dx).all()
        assert (after == after.T).all()
        assert np.linalg.eigvalsh(after / np.sqrt(np.outer(np.diag(after), np.diag(after)))).min() > -1e-6
        assert (np.diag(after) > 0.0).all()


SMOOTH: dict[str, Any] = {
    "noise.enabled": False,
    "camera.miss_probability": 0.0,
    "v2x": {"delay": 0, "loss": 0.0, "staleness": None},
    "vehicles.*.initial_estimate.position_radius": 0.01,
    "vehicles.*.initial_estimate.orientation_angle": 0.005,
}
SEED, DECISIONS, WORLDS = 3, 8, 2


def scenario(**more: Any) -> Scenario:
    return coopenv.load_scenario(FOUR_WAY, {**SMOOTH, **more})


KINDS = {
    "speed": {},
    "omnidirectional": {"dynamics.model": "omnidirectional"},
    "acceleration": {"action.longitudinal": "acceleration"},
}


@pytest.fixture(
    scope="module", params=["speed", *(pytest.param(name, marks=pytest.mark.slow) for name in [*KINDS][1:])]
)
def made(request: pytest.FixtureRequest) -> Scenario:
    return scenario(**KINDS[request.param])


def commands(made: Scenario, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-0.6, 0.6, (DECISIONS, WORLDS, 4, made.columns))


def test_forward_equals_the_world(made: Scenario) -> None:
    rollout = DifferentiableWorld(made, WORLDS).rollout(commands(made), SEED)
    world = simulate(made, WORLDS)
    world.reset(world_keys(SEED, WORLDS))
    for command in commands(made):
        world.actions.assign(command)
        world.advance(made.ticks_per_decision)
    L = len(made.landmarks)
    np.testing.assert_allclose(rollout.position, world.state.position.numpy()[:, L:], atol=1e-12)
    np.testing.assert_allclose(rollout.covariance, world.state.covariance.numpy(), atol=1e-11)
    estimate = np.einsum("wnij,wnj->wni", world.state.estimate_rotation.numpy(), world.state.estimate_position.numpy())
    np.testing.assert_allclose(rollout.position_estimate, estimate, atol=1e-11)
    assert rollout.uncertainty == pytest.approx(np.trace(rollout.covariance, axis1=-2, axis2=-1).sum())


def test_gradient_equals_finite_differences(made: Scenario) -> None:
    differentiable = DifferentiableWorld(made, WORLDS)
    base = commands(made)
    gradient = differentiable.rollout(base, SEED).gradient
    assert gradient.shape == base.shape and np.abs(gradient).max() > 1e-4
    rng = np.random.default_rng(5)
    for _ in range(3):  # of all actions at once: targets come into view and leave it
        step = rng.normal(size=base.shape)
        step *= 1e-5 / np.linalg.norm(step)
        up, down = (differentiable.rollout(base + sign * step, SEED).uncertainty for sign in (1, -1))
        assert (gradient * step).sum() == pytest.approx((up - down) / 2, rel=1e-3)


def test_descent_lowers_the_uncertainty(made: Scenario) -> None:
    differentiable = DifferentiableWorld(made, WORLDS)
    base = commands(made, 1)
    first = differentiable.rollout(base, SEED)
    direction = first.gradient / np.abs(first.gradient).max()
    assert differentiable.rollout(base - 0.05 * direction, SEED).uncertainty < first.uncertainty


@pytest.mark.parametrize(("camera", "odometry"), [(60.0, 100.0), (60.0, 37.0), (30.0, 1000.0), (50.0, 50.0)])
def test_intervals_cover_a_tick_and_take_every_sample(camera: float, odometry: float) -> None:
    samples = 0
    for tick in range(1, 61):
        intervals = tick_intervals(tick, camera, odometry)
        assert sum(duration for duration, _ in intervals) == pytest.approx(1 / camera)
        samples += sum(sampled for _, sampled in intervals)
    assert samples == int(60 / camera * odometry + 1e-9)


@pytest.mark.parametrize(
    "change",
    [
        {"noise.enabled": True},
        {"v2x": {"delay": 1}},
        {"camera.miss_probability": 0.1},
        {"observer.k": 2.0},
        {"observer.name": "dead_reckoning"},
        {"camera.quantise": True},
        {"rates.observer": 30.0},
        {"vehicles.0.motion": {"kind": "static"}},
        {"dynamics.model": "tests.helpers.builders:vehicle"},
    ],
)
def test_scenarios_without_a_derivative_are_refused(change: dict[str, Any]) -> None:
    with pytest.raises(coopenv.ScenarioError, match="differentiable rollout needs"):
        check_differentiable(scenario(**change))


def test_wrong_commands(made: Scenario) -> None:
    with pytest.raises(coopenv.ActionError, match="expected"):
        DifferentiableWorld(made, WORLDS).rollout(np.zeros((3, 1, 4, 2)))
