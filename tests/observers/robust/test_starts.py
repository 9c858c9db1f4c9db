"""`robust` knows how wrong it is from the start on, for every vehicle of every environment that embeds it."""

from __future__ import annotations

import numpy as np
import pytest

import coopenv
from coopenv.api.engine import Engine
from coopenv.estimation.poses import Coordinates
from coopenv.observers.runner import start_covariances
from coopenv.scenario import load_scenario
from tests.helpers.robust_worlds import estimates, nees_of

EMBEDDING = [name for name in coopenv.list_envs() if load_scenario(name).observer.name == "robust"]


def started(name: str) -> Engine:
    """Return worlds of an environment at the start of an episode."""
    scenario = load_scenario(name)
    if scenario.backend == "highway":
        pytest.importorskip("highway_env", reason="needs the extra highway")
    engine = Engine(scenario, 24 if scenario.backend == "highway" else 256, "float64")
    engine.reset(range(engine.world.worlds))
    return engine


@pytest.mark.parametrize("name", EMBEDDING)
def test_the_first_estimate_is_off_by_what_its_covariance_says(name: str) -> None:
    """Of errors that are no Gaussian the mean NEES is exact, too: 3 of a turn and 3 of a place.

    Of a place uniform in a ball of radius r with the variance r^2 / 5 per axis, NEES is 5 u^2 with u^3 uniform: its
    variance is 12/7. Of a turn uniform in [0, a] with a^2 / 9 it is 9 u^2 with u uniform: 36/5.
    """
    engine = started(name)
    scenario, (R_hat, p_hat) = engine.backend.scenario, estimates(engine.world)
    assert all(v.initial_estimate.position is None and v.initial_estimate.yaw is None for v in scenario.vehicles)
    R, p = (engine.view(part)[:, len(scenario.landmarks) :] for part in ("rotation", "position"))
    error = Coordinates.LEFT.error(R, p, R_hat, p_hat)
    squared = error**2 / np.diagonal(start_covariances(scenario), axis1=1, axis2=2)
    for part, variance in ((squared[..., :3], 36 / 5), (squared[..., 3:], 12 / 7)):
        mean = part.sum(axis=-1).mean(axis=0)
        assert (abs(mean - 3.0) < 4.5 * np.sqrt(variance / len(part))).all(), mean


@pytest.mark.parametrize("name", EMBEDDING)
def test_the_first_seconds_are_off_by_what_their_covariances_say(name: str) -> None:
    """Also where others come into view before anything is known of how fast they go."""
    engine = started(name)
    for _ in range(20):
        engine.step(np.zeros(engine.view("actions").shape), ticks=1)
        anees = np.nanmean(nees_of(engine.world)[0], axis=0)
        assert (anees > 0.5).all() and (anees < 2.0).all(), anees
    engine.close()
