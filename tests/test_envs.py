"""One suite for every file in envs/: whatever environment is added has to pass it."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from functools import cache, partial

import gymnasium
import numpy as np
import pettingzoo
import pytest
from gymnasium.utils.env_checker import check_env

import coopenv
from coopenv.base.installation import environment_id
from tests.helpers import env_suite
from tests.helpers.env_suite import CHECKS, SHIPPED, Make, assert_equal, random_actions, rendering, rollout

SMALLER = {"city": {"streets.blocks": [2, 2], "vehicles.0.count": 8, "vehicles.1.count": 4}}
"""Overrides that make large environments quick to test."""


@cache
def short(name: str) -> coopenv.Scenario:
    return coopenv.load_scenario(name, {"horizon": 6.0, **SMALLER.get(name, {})})


@pytest.fixture(scope="module", params=env_suite.each_slow(SHIPPED, *env_suite.ALIKE))
def name(request: pytest.FixtureRequest) -> str:
    if SHIPPED[request.param].backend == "highway":
        pytest.importorskip("highway_env", reason="needs the extra highway")
    return str(request.param)


@pytest.mark.parametrize("check", [c for c in CHECKS if c is not rendering], ids=lambda check: check.__name__)
def test_suite(name: str, check: Callable[[Make], None]) -> None:
    check(partial(coopenv.parallel_env, short(name)))


@pytest.mark.parametrize("drawn", ["busy_intersection", "urban_crossing", "highway_roundabout"])
def test_rendering(drawn: str) -> None:
    """One of each kind of motion; that every environment is drawn is tested in tests/viz/test_topview.py."""
    if drawn == "highway_roundabout":
        pytest.importorskip("highway_env", reason="needs the extra highway")
    rendering(partial(coopenv.parallel_env, short(drawn)))


def test_registries(name: str) -> None:
    identity = environment_id(name)
    parallel = pettingzoo.make("parallel", identity)
    assert parallel.possible_agents == [SHIPPED[name].vehicle_names[i] for i in SHIPPED[name].agents()]
    assert parallel.metadata["name"] == f"{name}_v0"
    short = pettingzoo.make("parallel", identity, max_cycles=7).scenario
    assert short.horizon_ticks == 7 * short.ticks_per_decision
    assert pettingzoo.make("aec", identity).possible_agents == parallel.possible_agents
    single = gymnasium.make(identity, overrides=SMALLER.get(name))
    check_env(single.unwrapped, skip_render_check=True)


def test_copies_go_on_where_the_original_is(name: str) -> None:
    """With the noise, too; the third is another environment, which was elsewhere, with the state of this one."""
    env = coopenv.parallel_env(short(name))
    rollout(env, 4, 12)
    restored = coopenv.parallel_env(env.scenario)
    restored.reset(seed=99)
    restored.set_state(env.get_state())
    twins = [copy.deepcopy(env), pickle.loads(pickle.dumps(env)), restored]
    rng = np.random.default_rng(1)
    for _ in range(10):
        actions = random_actions(env, rng)
        step = env.step(actions)
        for twin in twins:
            assert_equal(step, twin.step(actions))
