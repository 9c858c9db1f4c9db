"""The world for trainers that put infos into arrays."""

from __future__ import annotations

import numpy as np
import pytest
from pettingzoo.test import parallel_api_test

import coopenv
from coopenv.api.parallel_env import NUMBERS, PlainInfos
from tests.helpers.four_way import FOUR_WAY


def test_infos_are_numbers_and_hold_no_truth() -> None:
    env, full = PlainInfos(coopenv.parallel_env(FOUR_WAY)), coopenv.parallel_env(FOUR_WAY)
    observations, infos = env.reset(seed=3)
    expected, complete = full.reset(seed=3)
    for _ in range(20):
        assert set(infos) == set(env.agents)
        for agent, info in infos.items():
            assert tuple(info) == NUMBERS
            assert all(type(value) is float for value in info.values())
            assert info["nees"] == complete[agent]["nees"]
            assert np.array_equal(observations[agent], expected[agent])
        actions = {agent: np.full(2, 0.1, dtype=np.float32) for agent in env.agents}
        observations, _, _, _, infos = env.step(actions)
        expected, _, _, _, complete = full.step(actions)


def test_events_show_once_and_actions_of_the_dead_are_dropped() -> None:
    env = PlainInfos(coopenv.parallel_env(FOUR_WAY))
    env.reset(seed=0)
    turns = {agent: np.array([1.0, 0.2 + 0.1 * i], dtype=np.float32) for i, agent in enumerate(env.possible_agents)}
    collided = dict.fromkeys(env.possible_agents, 0.0)
    while env.agents:
        _, _, terminated, _, infos = env.step(turns)  # for all, the dead included
        for agent, info in infos.items():
            assert (info["arrived"] + info["collided"] == 1.0) == terminated[agent]
            collided[agent] += info["collided"]
    assert set(collided.values()) == {1.0}


def absent_at(env: PlainInfos) -> int:
    """Return a seed at which the first vehicle is absent."""
    for seed in range(100):
        env.reset(seed=seed)
        if "vehicle_1" not in env.agents:
            return seed
    raise AssertionError("the first vehicle is never absent")


@pytest.mark.parametrize("observation", ["flat", "dict"])
def test_a_reset_has_absent_vehicles_on_request(observation: str) -> None:
    plain, full = (
        PlainInfos(coopenv.parallel_env("urban_crossing", observation=observation), with_absent=with_absent)
        for with_absent in (False, True)
    )
    seed = absent_at(plain)
    expected, (observations, infos) = plain.reset(seed=seed), full.reset(seed=seed)
    assert set(observations) == set(infos) == set(full.possible_agents)
    assert full.agents == plain.agents and set(expected[0]) == set(plain.agents)
    np.testing.assert_equal({agent: observations[agent] for agent in plain.agents}, expected[0])
    assert full.observation_space("vehicle_1").contains(observations["vehicle_1"])
    assert tuple(infos["vehicle_1"]) == NUMBERS and not any(infos["vehicle_1"].values())


def test_conforms() -> None:
    env = PlainInfos(coopenv.parallel_env(FOUR_WAY))
    parallel_api_test(env, num_cycles=100)
    env.reset(seed=0)
    assert env.state_space.contains(env.state())
    with pytest.raises(coopenv.ActionError, match="no action for 'vehicle_1'"):
        env.step({})
