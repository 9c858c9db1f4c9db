"""`robust` in scenes in which cars are driven: it knows how wrong it is."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from coopenv.scenario import Scenario
from coopenv.scenario.files import load_scenario
from coopenv.world.world import World
from tests.helpers.four_way import FOUR_WAY
from tests.helpers.robust_worlds import estimates, watched
from tests.helpers.warp_calls import DTYPES

Driver = Callable[[World, int, np.ndarray], np.ndarray | float]

CORNERS = [(x, y) for x in (-3.8, 3.8) for y in (-3.8, 3.8)]
SIDES = [
    (sx * a, sy * b) for sx in (-1, 1) for sy in (-1, 1) for a, b in ((5.5, 3.9), (3.9, 5.5), (7.5, 4.0), (4.0, 7.5))
]
HEIGHTS = (0.3, 0.6, 0.9, 0.5, 0.7)


def square(**overrides: object) -> Scenario:
    """Return four cars on an open square whose landmarks are seen by those only that look aside."""
    landmarks = [{"name": f"L{n}", "position": [x, y, HEIGHTS[n % 5]]} for n, (x, y) in enumerate(CORNERS + SIDES)]
    start = {"vehicle_defaults.initial_estimate": {"position_radius": 0.3, "orientation_angle": 0.15}}
    open_space = {"obstacles": [], "landmarks": landmarks, "camera.range": 6.0, "horizon": 20.0}
    return load_scenario(FOUR_WAY, {**open_space, **start, "observer.name": "robust", **overrides})


def weaving(world: World, k: int, phase: np.ndarray) -> np.ndarray:
    """Return actions (W, N, 2) of drivers that weave along their lanes."""
    R, p = estimates(world)
    goal = world.view("goal").astype(float)
    start = world.view("start_position")[:, world.model.landmarks :].astype(float)
    along = (goal - start) / np.linalg.norm(goal - start, axis=-1, keepdims=True)
    ahead = start + along * (np.einsum("wni,wni->wn", p - start, along) + 1.5)[..., None] - p
    heading = np.arctan2(ahead[..., 1], ahead[..., 0]) + 0.6 * np.sin(0.16 * k + phase)
    turn = heading - np.arctan2(R[..., 1, 0], R[..., 0, 0])
    return np.stack([np.ones_like(turn), 3.0 * np.arctan2(np.sin(turn), np.cos(turn))], -1)


def turning_hard(world: World, k: int, phase: np.ndarray) -> np.ndarray:
    """Return actions (W, N, 2) of drivers that steer as far as they can, to either side in turn."""
    return np.stack([np.full(phase.shape, 0.5), np.sign(np.sin(0.09 * k + phase))], -1)


def driven(
    scenario: Scenario, driver: Driver, worlds: int, dtype: str, seconds: int
) -> tuple[np.ndarray, np.ndarray, World]:
    """Return NEES / 6 (K, W, N) and position errors in m of vehicles under way, and the world in the end."""
    phase = np.random.default_rng(0).uniform(0, 2 * np.pi, (worlds, len(scenario.vehicles)))
    return watched(
        scenario,
        range(1000, 1000 + worlds),
        10 * seconds,
        6,
        dtype=dtype,
        act=lambda world, k: np.asarray(driver(world, k, phase)),
    )


@pytest.mark.parametrize("dtype", DTYPES)
def test_hard_turns_are_in_the_covariance(dtype: str) -> None:
    """Samples of odometry that are held lag behind: with a lag of half a period ANEES/6 would be 1.86."""
    nees, errors, _ = driven(square(), turning_hard, 48, dtype, 14)
    assert 0.8 < np.nanmean(nees[30:]) < 1.2
    assert np.nanpercentile(errors[80:], 95) < 0.03


def test_cars_that_see_little_but_each_other_are_consistent() -> None:
    """With covariances left about poses before their correction ANEES/6 would be 1.6, at worst 80."""
    nees, _, _ = driven(square(), weaving, 96, "float32", 12)
    assert 0.8 < np.nanmean(nees[30:]) < 1.35
    assert np.nanmean(nees[30:] > 5.0) < 3e-3
