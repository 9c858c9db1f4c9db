"""The reward term `scored_error` is the score: an episode's sum is that of the errors that drivers are judged by."""

from __future__ import annotations

import numpy as np
import pytest

from coopenv.api.engine import Engine
from coopenv.evaluation import drive, held_out_seeds
from coopenv.evaluation.metrics import scored_errors
from coopenv.policies import load_agent
from coopenv.scenario import load_scenario

WORLDS = 6


def crash(observations: np.ndarray) -> np.ndarray:
    """Drive straight on, some vehicles at full speed and others slowly."""
    return np.stack([np.linspace(-0.6, 1.0, len(observations)), np.full(len(observations), 0.02)], axis=1)


@pytest.mark.parametrize(
    ("environment", "driver", "overrides"),
    [
        ("open_square", "crash", {}),
        ("take_turns", "crash", {"horizon": 20.0}),  # off the route, or still under way at the horizon
        ("urban_crossing", "route_follower", {"horizon": 20.0}),  # some vehicles are absent
        ("large_crossing", "crash", {"horizon": 10.0}),  # new routes after an arrival
    ],
)
def test_the_sum_of_the_term_is_that_of_the_scored_errors(
    environment: str, driver: str, overrides: dict[str, float]
) -> None:
    weights = dict.fromkeys(load_scenario(environment).reward.by_name, 0.0) | {"scored_error": 1.0}
    reward = {"reward.team": "own", "reward.weights": weights, "reward.privileged": True}
    scenario = load_scenario(environment, {**overrides, **reward})
    policy = crash if driver == "crash" else load_agent(driver, scenario)
    episodes = drive(Engine(scenario, WORLDS), policy, held_out_seeds(11, WORLDS))
    errors, worlds = scored_errors(episodes)
    expected = np.bincount(worlds, errors, WORLDS) * episodes.period
    np.testing.assert_allclose(-episodes.reward.sum(axis=(0, 2)), expected, rtol=1e-4, atol=1e-3)
    assert driver != "crash" or (episodes.lost_for > 0).any()
