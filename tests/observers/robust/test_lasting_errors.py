"""`robust` learns the scale error of its odometry and its gyro's bias, and knows how well."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from coopenv.observers.robust.constants import GYRO_BIAS
from coopenv.scenario.files import load_scenario
from coopenv.world.world import World
from tests.helpers.builders import reset, simulate
from tests.helpers.robust_worlds import nees_of, steps_of
from tests.observers.robust.test_driving import driven, square, weaving

LASTING = {"noise.odometry_scale": 0.03, "noise.gyro_bias": 0.0087}
YAW_ONLY = LASTING | {"noise.gyro_bias": [0.0, 0.0, 0.0087]}
ROBUST = {"observer.name": "robust"}


def still(world: World, k: int, phase: np.ndarray) -> float:
    """Return the action of who follows a prescribed motion."""
    return 0.0


def tell(name: str, lasting: dict[str, Any], nees: np.ndarray, errors: np.ndarray) -> None:
    """Print ANEES / 6 with its standard error over worlds and the 95th percentile of position errors (`pytest -s`)."""
    worlds, e95 = np.nanmean(nees, axis=(0, 2)), 100.0 * np.nanpercentile(errors, 95)
    std = np.nanstd(worlds) / np.sqrt(len(worlds))
    print(f"\n{name}, {lasting or 'none'}: ANEES/6 {worlds.mean():.2f} +- {std:.2f}, e95 {e95:.0f} cm")


def normalised_errors(world: World) -> np.ndarray:
    """Return (W, N, 4) errors of the estimated biases and scale in standard deviations."""
    memory: Any = world.memory
    believed, P = memory.member.numpy()[:, :, 1], memory.P.numpy()[:, :, 1, 1]
    scale = believed["v"][..., 0] - world.view("odometry_scale")
    errors = np.concatenate([believed["w"] - world.view("gyro_bias"), scale[..., None]], -1)
    return errors / np.sqrt(np.einsum("wnii->wni", P)[..., :4])


def test_a_small_bias_is_estimated_where_none_is_declared() -> None:
    """Its prior deviation is that of the constants, and the vehicle that sees landmarks reduces it."""
    scenario = load_scenario("busy_intersection_tracking", ROBUST)
    world, prior = simulate(scenario, 1), GYRO_BIAS**2
    reset(world)
    memory: Any = world.memory
    assert (memory.belief.numpy()["first_sender"] == 2).all()
    np.testing.assert_allclose(np.einsum("wnii->wni", memory.P.numpy()[:, :, 1, 1])[..., :3], prior)
    world.advance(480)  # 8 s, in which it would walk by eight times as much
    assert (memory.P.numpy()[0, 0, 1, 1].diagonal()[:3] < 0.5 * (1.0 + 8.0) * prior).all()


@pytest.mark.parametrize("lasting", [LASTING, YAW_ONLY])
def test_vehicles_on_prescribed_paths_know_their_errors(lasting: dict[str, Any]) -> None:
    scenario = load_scenario("busy_intersection_tracking", ROBUST | lasting)
    nees, _, world = driven(scenario, still, 16, "float64", 8)
    assert 0.5 < np.nanmean(nees[20:]) < 1.5
    squared = normalised_errors(world)[:, :3] ** 2  # of those that see landmarks early
    assert (squared.mean(axis=(0, 1)) < 2.0).all()
    assert np.sqrt(world.memory.P.numpy()[:, :3, 1, 1, 3, 3]).max() < 0.02  # it was declared to be 0.03


def test_driven_cars_know_their_errors() -> None:
    nees, _, world = driven(square(**LASTING), weaving, 48, "float32", 10)
    assert 0.5 < np.nanmean(nees[20:]) < 1.5
    assert (normalised_errors(world) ** 2).mean() < 2.0


@pytest.mark.slow
@pytest.mark.parametrize("lasting", [LASTING, YAW_ONLY, {}])
def test_a_whole_episode_on_prescribed_paths(lasting: dict[str, Any]) -> None:
    scenario = load_scenario("busy_intersection_tracking", ROBUST | lasting)
    nees, errors, _ = driven(scenario, still, 32, "float64", 40)
    tell("tracking from 2 s on", lasting, nees[20:], errors[20:])
    for part in (nees[20:150], nees[150:]):
        assert 0.5 < np.nanmean(part) < 1.5
    assert 0.8 < np.nanmean(nees[350:]) < 1.2


@pytest.mark.slow
@pytest.mark.parametrize("lasting", [LASTING, {}])
@pytest.mark.parametrize("agent", ["route_follower", "peek"])
@pytest.mark.parametrize("environment", ["open_square", "facade", "behind_truck", "urban_crossing"])
def test_drivers_know_their_errors(environment: str, agent: str, lasting: dict[str, Any]) -> None:
    scenario = load_scenario(environment, ROBUST | lasting)
    found = [nees_of(engine.world) for engine in steps_of(agent, scenario, 128, 0)]
    nees, errors = (np.array(part)[20:] for part in zip(*found, strict=True))
    known = np.isfinite(nees).sum(axis=0)
    # By world, so that one that strays until the end counts as the others do; not there at all: NaN.
    vehicles = np.where(known > 0, np.nansum(nees, axis=0) / np.maximum(known, 1), np.nan)
    std = np.nanstd(vehicles, axis=0) / np.sqrt((known > 0).sum(axis=0))
    means = np.nanmean(vehicles, axis=0)
    told = ", ".join(f"{mean:.2f} +- {error:.2f}" for mean, error in zip(means, std, strict=True))
    tell(f"{environment}, {agent}, by vehicle {told}", lasting, nees, errors)
    assert ((means + 2.0 * std > 0.5) & (means - 2.0 * std < 1.5)).all()
