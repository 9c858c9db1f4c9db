"""One suite for every agent in agents/."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import coopenv
from coopenv.bench.drivers import play, score
from coopenv.policies import load_agent, read_card
from coopenv.shipped import data_directory, list_agents

PAIRS = [(agent, env) for agent in list_agents() for env in read_card(agent).environments]


def test_there_are_agents() -> None:
    assert "give_way" in list_agents()


@pytest.mark.parametrize("agent", list_agents())
def test_agent_has_a_card_with_results(agent: str) -> None:
    card = (data_directory("agents") / agent / "README.md").read_text(encoding="utf-8")
    assert f"coopenv bench agents {agent}" in card


@pytest.mark.parametrize(("agent", "name"), PAIRS)
def test_agent_drives(agent: str, name: str) -> None:
    env = coopenv.parallel_env(name)
    policy = load_agent(agent, env.observation_layout)
    observations, _ = env.reset(seed=1000)
    for _ in range(60):
        actions = {a: policy.act(observations[a]) for a in env.agents}
        assert all(env.action_space(a).contains(action) for a, action in actions.items())
        observations, *_ = env.step(actions)


def test_give_way_arrives_without_touching() -> None:
    env = coopenv.parallel_env("urban_crossing")
    policy = load_agent("give_way", env.observation_layout)
    result = score(play(env, policy, seed) for seed in range(500, 520))
    assert result.collided == 0.0
    assert result.arrived >= 0.95
    zero = score(play(env, Still(), seed) for seed in range(500, 503))
    assert zero.mean_return < result.mean_return


class Still:
    def act(self, observation: np.ndarray) -> np.ndarray:
        return np.array([-1.0, 0.0], dtype=np.float32)


def test_bad_agents(tmp_path: Path) -> None:
    env = coopenv.parallel_env("urban_crossing")
    with pytest.raises(coopenv.CoopenvError, match=r"unknown agent 'giveway' \(did you mean 'give_way'\?\)"):
        load_agent("giveway", env.observation_layout)
    (tmp_path / "agent.toml").write_text('title = "x"')
    with pytest.raises(coopenv.CoopenvError, match=r"agent\.toml: description: Field required"):
        load_agent(str(tmp_path), env.observation_layout)
    card = 'title = "x"\ndescription = "y"\nenvironments = []\nentry = "{}"\n'
    (tmp_path / "agent.toml").write_text(card.format("os:system"))
    with pytest.raises(coopenv.CoopenvError, match=r"entry must be 'coopenv\.module:Class'"):
        load_agent(str(tmp_path), env.observation_layout)
    (tmp_path / "agent.toml").write_text(card.format("coopenv.policies.give_way:GiveWay") + "[options]\nspeeed = 1\n")
    with pytest.raises(coopenv.CoopenvError, match="speeed"):
        load_agent(str(tmp_path), env.observation_layout)
