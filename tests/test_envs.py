"""One suite for every file in envs/: whatever environment is added has to pass it."""

from __future__ import annotations

import copy
import pickle
import re
import warnings
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pettingzoo
import pytest
from gymnasium.utils.env_checker import check_env
from pettingzoo.test import api_test, parallel_api_test, render_test, seed_test
from pettingzoo.test.state_test import state_test
from pettingzoo.utils import parallel_to_aec

import coopenv
from coopenv.api.registration import environment_id

ENVS = coopenv.list_envs()
Env = coopenv.CooperativeLocalisationEnv


@pytest.fixture(params=ENVS)
def name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def random_actions(env: Env, rng: np.random.Generator) -> dict[str, np.ndarray]:
    return {agent: rng.uniform(-1.0, 1.0, 2).astype(np.float32) for agent in env.agents}


def rollout(env: Env, seed: int, steps: int) -> list[Any]:
    rng = np.random.default_rng(seed)
    record: list[Any] = [env.reset(seed=seed)]
    for _ in range(steps):
        if not env.agents:
            break
        record.append(env.step(random_actions(env, rng)))
    return record


def assert_equal(a: Any, b: Any) -> None:
    if isinstance(a, dict):
        assert a.keys() == b.keys()
        for key in a:
            assert_equal(a[key], b[key])
    elif isinstance(a, list | tuple):
        assert len(a) == len(b)
        for x, y in zip(a, b, strict=True):
            assert_equal(x, y)
    else:
        assert np.array_equal(a, b), (a, b)


def test_ships_the_papers_scenarios() -> None:
    assert {"crossing_path", "overtaking", "busy_intersection", "busy_intersection_mirror"} <= set(ENVS)


def test_official_tests(name: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        parallel_api_test(coopenv.parallel_env(name), num_cycles=600)
        api_test(parallel_to_aec(coopenv.parallel_env(name)), num_cycles=1500)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # PettingZoo advises against Dict observations
        api_test(parallel_to_aec(coopenv.parallel_env(name, observation="dict")), num_cycles=200)


def test_seeds(name: str) -> None:
    seed_test(lambda: parallel_to_aec(coopenv.parallel_env(name)), num_cycles=300)


def test_state_space(name: str) -> None:
    env = coopenv.parallel_env(name)
    state_test(parallel_to_aec(env), env)


def test_rendering(name: str) -> None:
    def make(render_mode: str | None = None) -> Any:
        return parallel_to_aec(coopenv.parallel_env(name, render_mode=render_mode))

    render_test(make)


def test_registries(name: str) -> None:
    identity = environment_id(name)
    parallel = pettingzoo.make("parallel", identity)
    assert parallel.possible_agents == coopenv.load_scenario(name).vehicle_names
    assert parallel.metadata["name"] == f"{name}_v0"
    assert pettingzoo.make("parallel", identity, max_cycles=7).scenario.horizon_ticks == 7 * 6
    assert pettingzoo.make("aec", identity).possible_agents == parallel.possible_agents
    single = gymnasium.make(identity)
    check_env(single.unwrapped, skip_render_check=True)


def test_agent_names(name: str) -> None:
    env = coopenv.parallel_env(name)
    assert env.possible_agents == [f"vehicle_{i + 1}" for i in range(len(env.possible_agents))]
    assert all(re.fullmatch("[a-z]+_[0-9]+", agent) for agent in env.possible_agents)
    for agent in env.possible_agents:
        assert env.observation_space(agent) is env.observation_space(agent)
        assert env.action_space(agent) is env.action_space(agent)


@pytest.mark.parametrize("observation", ["flat", "dict"])
def test_rollout_equality_and_spaces(name: str, observation: Any) -> None:
    """Three rollouts of one seed agree exactly; every observation is in its space, finite, and a fresh array."""
    env = coopenv.parallel_env(name, observation=observation)
    first = rollout(env, 11, 10_000)
    assert len(first) > 20
    for step in first:
        for agent, seen in step[0].items():
            assert env.observation_space(agent).contains(seen)
            parts = list(seen.values()) if isinstance(seen, dict) else [seen]
            assert all(part.dtype == np.float32 and np.isfinite(part).all() for part in parts)
    kept = copy.deepcopy(first)
    assert_equal(rollout(env, 11, 10_000), first)
    assert_equal(kept, first)  # later steps did not write into what was handed out
    assert_equal(rollout(coopenv.parallel_env(name, observation=observation), 11, 10_000), first)
    other = rollout(env, 12, 30)
    assert any(not np.array_equal(a, b) for a, b in zip(_flatten(first[25]), _flatten(other[25]), strict=False))


def _flatten(step: Any) -> list[np.ndarray]:
    return [
        np.asarray(v) for agent in step[0].values() for v in (agent.values() if isinstance(agent, dict) else [agent])
    ]


def test_flat_and_dict_hold_the_same(name: str) -> None:
    flat, named = coopenv.parallel_env(name), coopenv.parallel_env(name, observation="dict")
    layout = flat.observation_layout
    a, b = rollout(flat, 3, 15), rollout(named, 3, 15)
    for x, y in zip(a, b, strict=True):
        for agent in x[0]:
            for field, place in layout.items():
                assert np.array_equal(x[0][agent][place.slice], y[0][agent][field])


def test_layout_covers_the_observation_once(name: str) -> None:
    env = coopenv.parallel_env(name)
    covered = np.zeros(env.observation_space("vehicle_1").shape, dtype=int)
    for field in env.observation_layout.values():
        covered[field.slice] += 1
        assert field.stop - field.start == int(np.prod(field.shape))
    assert (covered == 1).all()


def test_infos(name: str) -> None:
    env = coopenv.parallel_env(name, dtype="float64")
    steps = rollout(env, 5, 40)
    keys = set(steps[0][1]["vehicle_1"])
    weights = env.scenario.reward.weights.model_dump()
    for step in steps:
        for agent, info in step[-1].items():
            assert set(info) == keys
            truth, estimate = info["truth"], info["estimate"]
            assert info["position_error"] == pytest.approx(
                float(np.linalg.norm(truth["position"] - estimate["position"])), rel=1e-9
            )
            assert set(info["visible"]) <= set(env.scenario.target_names) - {agent}
            assert info["nees"] >= 0.0
            if len(step) == 5:
                total = sum(weights[term] * value for term, value in info["reward_terms"].items())
                assert step[1][agent] == pytest.approx(total, abs=1e-5)


def test_ends_by_itself(name: str) -> None:
    env = coopenv.parallel_env(name)
    steps = rollout(env, 0, 100_000)
    assert env.agents == []
    horizon = round(env.scenario.horizon * env.scenario.rates.decision)
    assert len(steps) - 1 <= horizon
    for agent in env.possible_agents:
        last = [step for step in steps[1:] if agent in step[1]][-1]
        assert last[2][agent] != last[3][agent]
        assert isinstance(last[2][agent], bool) and isinstance(last[3][agent], bool)
    assert env.step({}) == ({}, {}, {}, {}, {})


@pytest.mark.parametrize("copy_of", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_copies_go_on_where_the_original_is(name: str, copy_of: Callable[[Env], Env]) -> None:
    env = coopenv.parallel_env(name)
    rollout(env, 4, 12)
    twin = copy_of(env)
    rng_a, rng_b = np.random.default_rng(1), np.random.default_rng(1)
    for _ in range(10):
        assert_equal(env.step(random_actions(env, rng_a)), twin.step(random_actions(twin, rng_b)))


def test_saved_state_restores_noise_too(name: str) -> None:
    env = coopenv.parallel_env(name)
    rollout(env, 4, 12)
    saved = env.get_state()
    rng = np.random.default_rng(1)
    actions = [random_actions(env, rng) for _ in range(10)]
    first = [env.step(action) for action in actions]
    env.reset(seed=99)
    env.set_state(saved)
    assert_equal([env.step(action) for action in actions], first)


def test_reset_without_seed_draws_anew(name: str) -> None:
    env = coopenv.parallel_env(name, dtype="float64")
    env.reset(seed=7)
    runs = []
    for _ in range(2):
        env.reset()
        steps = [env.step({agent: np.zeros(2) for agent in env.agents}) for _ in range(3)]
        runs.append([info["estimate"]["position"] for info in steps[-1][-1].values()])
    assert not np.allclose(runs[0], runs[1], atol=1e-12)
