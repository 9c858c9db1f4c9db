"""In every environment that is there to learn to look, looking pays: nobody's edit takes its question away."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from coopenv.api.engine import Engine
from coopenv.evaluation import Episodes, compare_paired, drive, held_out_seeds, score
from coopenv.policies import load_agent
from coopenv.scenario import load_scenario

WORLDS = {"open_square": 32, "facade": 48, "behind_truck": 48, "urban_crossing": 24, "large_crossing": 6}
"""How many suffice for intervals that tell the drivers apart."""


@cache
def episodes(environment: str, agent: str, sensing: str = "sensed") -> Episodes:
    scenario = load_scenario(environment, {"sensing": sensing})
    worlds = WORLDS[environment] if sensing == "sensed" else WORLDS[environment] // 2
    return drive(Engine(scenario, worlds), load_agent(agent, scenario), held_out_seeds(9, worlds))


def figures(environment: str, agent: str, sensing: str = "sensed") -> dict[str, tuple[float, float, float]]:
    return {r.metric: (r.mean, r.ci_low, r.ci_high) for r in score(episodes(environment, agent, sensing))}


@pytest.mark.parametrize("environment", WORLDS)
def test_a_lookout_knows_far_better_where_it_is_and_loses_little_time(environment: str) -> None:
    straight, lookout = figures(environment, "route_follower"), figures(environment, "peek")
    change = {
        d.metric: d for d in compare_paired(episodes(environment, "peek"), episodes(environment, "route_follower"))
    }
    assert lookout["e95_m"][0] <= 0.5 * straight["e95_m"][0]
    assert lookout["e95_m"][2] < straight["e95_m"][1]  # the intervals are apart
    assert change["travel_time_s"].ci_low <= 0.05 * straight["travel_time_s"][0]


@pytest.mark.parametrize("environment", WORLDS)
def test_errors_depend_on_what_is_sensed(environment: str) -> None:
    ideal, sensed, blind = (
        figures(environment, "route_follower", how)["e95_m"] for how in ("ideal", "sensed", "blind")
    )
    assert ideal[2] < 0.5 * sensed[1]
    assert sensed[0] < blind[0]
    assert figures(environment, "route_follower", "ideal")["arrival_rate"][0] > 0.97


@pytest.mark.parametrize("environment", WORLDS)
def test_sensing_is_all_that_the_dial_changes(environment: str) -> None:
    """Under the same actions the truth is the same."""
    engines = [Engine(load_scenario(environment, {"sensing": how}), 4) for how in ("ideal", "sensed", "blind")]
    generator = np.random.default_rng(0)
    for engine in engines:
        engine.reset([0, 1, 2, 3])
    for _ in range(20):
        actions = generator.uniform(-1.0, 1.0, engines[0].view("actions").shape)
        for engine in engines:
            engine.step(actions)
    for name in ("position", "rotation", "speed", "odometry_velocity", "route", "ended"):
        for engine in engines[1:]:
            np.testing.assert_array_equal(engine.view(name), engines[0].view(name), err_msg=name)
