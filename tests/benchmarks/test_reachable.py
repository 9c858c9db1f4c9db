"""The search for what a fleet could reach: it begins at an agent's own plan, and finds better ones only."""

from __future__ import annotations

from contextlib import closing

import numpy as np
from numpy.testing import assert_allclose

from benchmarks.reachable import OpenLoop, driven, searched
from coopenv.api.engine import Engine
from coopenv.evaluation import held_out_seeds
from coopenv.policies import load_agent
from coopenv.scenario import load_scenario


def test_a_repeated_plan_leads_where_its_agent_was_and_the_search_finds_no_worse() -> None:
    scenario = load_scenario("scout_platoon", {"horizon": 6.0})
    (seed,) = held_out_seeds(41, 1)
    with closing(Engine(scenario, 1)) as single, closing(Engine(scenario, 6)) as many:
        outcome, actions = driven(single, load_agent("look_ahead", scenario), seed)
        again, _ = driven(many, OpenLoop(np.repeat(actions[:, 0], 6, axis=0).reshape(len(actions), -1, 2)), seed)
        assert_allclose(again.e95, outcome.e95[0], rtol=1e-6)
        assert_allclose(again.stated, outcome.stated[0], rtol=1e-6)
        best = searched(many, actions[:, 0], seed, 2, lambda: None)
    assert best.cost[0] <= outcome.cost[0] + 1e-6
