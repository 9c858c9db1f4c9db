"""Environments that are there to learn in have levels; "normal" is what their files say."""

from __future__ import annotations

import numpy as np
import pytest

import coopenv
from coopenv.api.engine import Engine
from coopenv.evaluation import drive, held_out_seeds, score
from coopenv.policies import load_agent
from coopenv.scenario import load_scenario
from coopenv.scenario.learning import Difficulty

LEARNING = ("open_square", "facade", "behind_truck", "urban_crossing", "large_crossing")


def observations(environment: str, level: str, **options: object) -> np.ndarray:
    """Return what 2 worlds are observed to be in the first steps at a level, which the file or a reset says."""
    overrides = {} if options else {"difficulty.level": level}
    env = coopenv.make_vec(environment, num_worlds=2, overrides=overrides, autoreset="disabled")
    seen = [env.reset(seed=3, options=options or None)[0]]
    seen += [env.step(np.full((env.num_envs, 2), 0.3, np.float32))[0] for _ in range(10)]
    env.close()
    return np.stack(seen)


@pytest.mark.parametrize("environment", LEARNING)
def test_a_level_is_said_in_the_file_or_at_a_reset(environment: str) -> None:
    easy, hard = observations(environment, "easy"), observations(environment, "hard")
    assert (easy != hard).mean() > 0.1
    np.testing.assert_array_equal(hard, observations(environment, "", difficulty="hard"))
    np.testing.assert_array_equal(easy, observations(environment, "", difficulty=0.0))


@pytest.mark.parametrize("environment", LEARNING)
def test_normal_is_what_the_file_says(environment: str) -> None:
    scenario = load_scenario(environment)
    assert scenario.difficulty.neutral and scenario.difficulty.matters
    found = []
    for difficulty in (scenario.difficulty, Difficulty()):
        engine = Engine(scenario.model_copy(update={"difficulty": difficulty}), 2)
        engine.reset([3, 4])
        for _ in range(10):
            engine.step(np.full(engine.view("actions").shape, 0.3))
        found.append(engine.view("observation").copy())
    np.testing.assert_allclose(*found, rtol=1e-5, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("environment", LEARNING)
@pytest.mark.parametrize("agent", ["route_follower", "peek"])
def test_what_is_harder_is_worse_known(environment: str, agent: str) -> None:
    errors = []
    for level in ("easy", "hard"):
        scenario = load_scenario(environment, {"difficulty.level": level})
        worlds = 128 // len(scenario.vehicles)
        episodes = drive(Engine(scenario, worlds), load_agent(agent, scenario), held_out_seeds(9, worlds))
        errors.append({result.metric: result for result in score(episodes)}["e50_m"])
    assert errors[0].ci_high < errors[1].ci_low


def test_a_level_that_means_nothing_is_refused() -> None:
    with pytest.raises(coopenv.CoopenvError, match=r"difficulty.*level: nothing depends on it; give factors"):
        load_scenario("busy_intersection", {"difficulty.level": "hard"})
    env = coopenv.parallel_env("busy_intersection")
    with pytest.raises(coopenv.CoopenvError, match="option 'difficulty': nothing depends on it here"):
        env.reset(seed=0, options={"difficulty": "hard"})
