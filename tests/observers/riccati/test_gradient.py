"""The differentiable rollout: same numbers as the world, and derivatives that finite differences confirm."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import coopenv
from coopenv.base.errors import world_keys
from coopenv.observers.riccati.gradient import DifferentiableWorld, check_differentiable, tick_intervals
from coopenv.scenario import Scenario
from tests.helpers.builders import simulate
from tests.helpers.four_way import FOUR_WAY

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


@pytest.fixture(scope="module", params=["speed", pytest.param("acceleration", marks=pytest.mark.slow)])
def made(request: pytest.FixtureRequest) -> Scenario:
    return scenario(**{"action.longitudinal": request.param})


def commands(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-0.6, 0.6, (DECISIONS, WORLDS, 4, 2))


def test_forward_equals_the_world(made: Scenario) -> None:
    rollout = DifferentiableWorld(made, WORLDS).rollout(commands(), SEED)
    world = simulate(made, WORLDS)
    world.reset(world_keys(SEED, WORLDS))
    for command in commands():
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
    base = commands()
    gradient = differentiable.rollout(base, SEED).gradient
    assert gradient.shape == base.shape and np.abs(gradient).max() > 1e-4
    step = 1e-5
    rng = np.random.default_rng(5)
    for _ in range(5):
        index = tuple(int(rng.integers(n)) for n in base.shape)
        moved = [base.copy(), base.copy()]
        moved[0][index] += step
        moved[1][index] -= step
        up, down = (differentiable.rollout(c, SEED).uncertainty for c in moved)
        assert gradient[index] == pytest.approx((up - down) / (2 * step), rel=1e-3, abs=1e-8)


def test_descent_lowers_the_uncertainty(made: Scenario) -> None:
    differentiable = DifferentiableWorld(made, WORLDS)
    base = commands(1)
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
    ],
)
def test_what_has_no_derivative_is_refused(change: dict[str, Any]) -> None:
    with pytest.raises(coopenv.ScenarioError, match="differentiable rollout needs"):
        check_differentiable(scenario(**change))


def test_wrong_commands(made: Scenario) -> None:
    with pytest.raises(coopenv.ActionError, match="expected"):
        DifferentiableWorld(made, WORLDS).rollout(np.zeros((3, 1, 4, 2)))
