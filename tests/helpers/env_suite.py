"""The suite that every environment passes, whatever is behind it: checks of what a function of options makes."""

from __future__ import annotations

import copy
import re
import warnings
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import pytest
from pettingzoo.test import api_test, parallel_api_test, render_test, seed_test
from pettingzoo.test.state_test import state_test
from pettingzoo.utils import parallel_to_aec

import coopenv

Env = coopenv.CooperativeLocalisationEnv
Make = Callable[..., Env]
"""Makes one and the same environment with options of `coopenv.parallel_env`: observation, dtype, render_mode."""

SHIPPED = {name: coopenv.load_scenario(name) for name in coopenv.list_envs()}
"""All environments: loaded once, however many files have a test of each."""

STEPS = 15
CHECKS: list[Callable[[Make], None]] = []
"""All checks that hold for environments of any backend."""


def check(function: Callable[[Make], None]) -> Callable[[Make], None]:
    CHECKS.append(function)
    return function


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


@check
def official_tests(make: Make) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        if any(vehicle.presence < 1.0 for vehicle in make().scenario.vehicles):
            parallel_api_test(make(overrides={"vehicles.*.presence": 1.0}), num_cycles=10)
            # Who is not there does not end either.
            warnings.filterwarnings("ignore", "No agents present but not all possible_agents are terminated")
        parallel_api_test(make(), num_cycles=10)
        api_test(parallel_to_aec(make()), num_cycles=10)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # PettingZoo advises against Dict observations
        api_test(parallel_to_aec(make(observation="dict")), num_cycles=10)


@check
def seeds(make: Make) -> None:
    seed_test(lambda: parallel_to_aec(make()), num_cycles=10)


@check
def state_space(make: Make) -> None:
    env = make()
    state_test(parallel_to_aec(env), env)


@check
def rendering(make: Make) -> None:
    render_test(lambda render_mode=None: parallel_to_aec(make(render_mode=render_mode)))


@check
def agent_names(make: Make) -> None:
    env = make()
    acting = [f"vehicle_{i + 1}" for i, acts in enumerate(env.scenario.acting) if acts]
    assert env.possible_agents == (acting or env.scenario.vehicle_names)
    assert all(re.fullmatch("[a-z]+_[0-9]+", agent) for agent in env.possible_agents)
    for agent in env.possible_agents:
        assert env.observation_space(agent) is env.observation_space(agent)
        assert env.action_space(agent) is env.action_space(agent)


@check
def rollouts_of_a_seed_are_equal(make: Make) -> None:
    """Rollouts of one seed agree exactly; every observation is in its space, finite, and a fresh array."""
    env = make()
    first = rollout(env, 11, STEPS)
    kept = copy.deepcopy(first)
    assert_equal(rollout(env, 11, STEPS), first)
    assert_equal(kept, first)  # later steps did not write into what was handed out
    assert_equal(rollout(make(), 11, STEPS), first)
    for step in first:
        for agent, seen in step[0].items():
            assert env.observation_space(agent).contains(seen) and np.isfinite(seen).all()
    other = rollout(env, 12, 10)[10][0]
    assert any(not np.array_equal(seen, other[agent]) for agent, seen in first[10][0].items() if agent in other)


@check
def flat_and_dict_hold_the_same(make: Make) -> None:
    flat, named = make(), make(observation="dict")
    for x, y in zip(rollout(flat, 3, 15), rollout(named, 3, 15), strict=True):
        for agent, row in x[0].items():
            assert named.observation_space(agent).contains(y[0][agent])
            places = {field: at for field, at in flat.observation_layout.items() if at.start < at.stop}
            assert y[0][agent].keys() == places.keys()
            for field, place in places.items():
                assert y[0][agent][field].dtype == row.dtype == np.float32
                assert np.array_equal(row[place.slice], y[0][agent][field])


@check
def layout_covers_the_observation_once(make: Make) -> None:
    env = make()
    covered = np.zeros(env.observation_space(env.possible_agents[0]).shape, dtype=int)
    for field in env.observation_layout.values():
        covered[field.slice] += 1
        assert field.stop - field.start == int(np.prod(field.shape))
    assert (covered == 1).all()


@check
def infos(make: Make) -> None:
    env = make(dtype="float64")
    steps = rollout(env, 5, STEPS)
    keys = set(next(iter(steps[0][1].values())))
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
            totals = {
                agent: sum(weights[term] * value for term, value in info["reward_terms"].items())
                for agent, info in step[-1].items()
            }
            if env.scenario.reward.team == "mean":
                totals = dict.fromkeys(totals, np.mean([*totals.values()]))
            assert {agent: step[1][agent] for agent in totals} == pytest.approx(totals, abs=1e-5)


@check
def ends_by_itself(make: Make) -> None:
    env = make()
    steps = rollout(env, 0, 100_000)
    assert env.agents == []
    horizon = round(env.scenario.horizon * env.scenario.rates.decision)
    assert len(steps) - 1 <= horizon
    for agent in steps[0][0]:
        last = [step for step in steps[1:] if agent in step[1]][-1]
        assert last[2][agent] != last[3][agent]
        assert isinstance(last[2][agent], bool) and isinstance(last[3][agent], bool)
    assert env.step({}) == ({}, {}, {}, {}, {})


@check
def reset_without_seed_draws_anew(make: Make) -> None:
    env = make(dtype="float64")
    env.reset(seed=7)
    runs = []
    for _ in range(2):
        env.reset()
        steps = [env.step({agent: np.zeros(2) for agent in env.agents}) for _ in range(3)]
        runs.append([info["estimate"]["position"] for info in steps[-1][-1].values()])
    assert not np.allclose(runs[0], runs[1], atol=1e-12)


def first_episodes(
    env: coopenv.CooperativeVectorEnv, seed: int, decisions: int, policy: Callable[[np.ndarray], np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return return, decisions and outcome of every vehicle's first episode; `env` is not reset automatically."""
    observation, _ = env.reset(seed=seed)
    returned, length, under_way = np.zeros(env.num_envs), np.zeros(env.num_envs), np.ones(env.num_envs, bool)
    for _ in range(decisions):
        observation, reward, terminated, truncated, infos = env.step(policy(observation))
        returned += np.where(under_way, reward, 0.0)
        length += under_way
        under_way &= ~(terminated | truncated)
    return returned, length, infos["ended"]


ALIKE = ("busy_intersection_mirror", "busy_intersection_tracking", "city", "highway_intersection")
ALIKE += ("large_crossing", "overtaking", "scout_platoon", "take_turns")
"""Environments whose files use what those of others use, too; the quick tests do without them."""

LARGEST = ("large_crossing", "urban_crossing")
"""Environments whose figures take longest; the quick tests do without them where others ask the same."""


def rest_slow(values: Iterable[Any], *kept: int) -> list[Any]:
    """Return parameters, all marked slow but those at some places: CI has half an hour on the slowest machine."""
    rows = [value if isinstance(value, tuple) else (value,) for value in values]
    return [pytest.param(*row, marks=() if n in kept else pytest.mark.slow) for n, row in enumerate(rows)]


def each_slow(environments: Iterable[str], *slow: str) -> list[Any]:
    """Return environments as parameters, some of them marked slow."""
    return [pytest.param(name, marks=pytest.mark.slow) if name in slow else name for name in environments]


def largest_slow(environments: Iterable[str], *more: str) -> list[Any]:
    """Return environments as parameters, the largest ones and some more marked slow."""
    return each_slow(environments, *LARGEST, *more)
