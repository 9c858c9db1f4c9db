"""One suite for every agent in agents/."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import coopenv
from coopenv.bench.drivers import play, score
from coopenv.policies import act, load_agent, load_policy, read_card
from coopenv.runs.rollouts import Rollout
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
    policy = load_agent(agent, env.scenario)
    observations, _ = env.reset(seed=1000)
    for _ in range(60):
        actions = act(policy, {a: observations[a] for a in env.agents})
        assert all(env.action_space(a).contains(action) for a, action in actions.items())
        observations, *_ = env.step(actions)


def test_give_way_arrives_without_touching() -> None:
    env = coopenv.parallel_env("urban_crossing")
    policy = load_agent("give_way", env.scenario)
    result = score("give_way", "urban_crossing", (play(env, policy, seed) for seed in range(500, 520)))
    assert result.collided == 0.0
    assert result.arrived >= 0.95
    still = score("still", "urban_crossing", (play(env, stand_still, seed) for seed in range(500, 503)))
    assert still.mean_return < result.mean_return


def stand_still(observations: np.ndarray) -> np.ndarray:
    return np.tile(np.float32([-1.0, 0.0]), (len(observations), 1))


@pytest.mark.parametrize(("top", "reverse"), [(1.0, False), (1.53, False), (2.0, True)])
def test_give_way_drives_at_its_speed_whatever_the_car_can_do(top: float, reverse: bool) -> None:
    overrides = {"dynamics.max_speed": top, "dynamics.reverse": reverse, "observer.name": "robust"}
    scenario = coopenv.load_scenario("urban_crossing", overrides)
    rollout = Rollout(scenario, seed=1, policy="give_way", steps=60)
    for _ in rollout.play():
        pass
    fastest = np.abs(rollout.trajectory().velocity[:, :, 0]).max()
    assert fastest == pytest.approx(0.6, abs=0.02)


def test_give_way_refuses_to_choose_accelerations() -> None:
    scenario = coopenv.load_scenario("urban_crossing", {"action.longitudinal": "acceleration"})
    with pytest.raises(coopenv.CoopenvError, match=r"agent 'give_way' cannot be built: it chooses speeds"):
        load_agent("give_way", scenario)


def test_policies_by_name() -> None:
    scenario = coopenv.load_scenario("urban_crossing")
    rows = np.zeros((4, 132), dtype=np.float32)
    assert not load_policy("zero", scenario, 0)(rows).any()
    first, again, other = (load_policy("random", scenario, seed)(rows) for seed in (1, 1, 2))
    assert first.shape == (4, 2) and (first == again).all() and (first != other).any()
    with pytest.raises(coopenv.CoopenvError, match=r"unknown policy 'randm' \(did you mean 'random'\?\)"):
        load_policy("randm", scenario, 0)


def test_bad_agents(tmp_path: Path) -> None:
    env = coopenv.parallel_env("urban_crossing")
    with pytest.raises(coopenv.CoopenvError, match=r"unknown agent 'giveway' \(did you mean 'give_way'\?\)"):
        load_agent("giveway", env.scenario)
    (tmp_path / "agent.toml").write_text('title = "x"')
    with pytest.raises(coopenv.CoopenvError, match=r"agent\.toml: description: Field required"):
        load_agent(str(tmp_path), env.scenario)
    card = 'title = "x"\ndescription = "y"\nenvironments = []\nentry = "{}"\n'
    (tmp_path / "agent.toml").write_text(card.format("os:system"))
    with pytest.raises(coopenv.CoopenvError, match=r"entry must be 'coopenv\.module:Class'"):
        load_agent(str(tmp_path), env.scenario)
    (tmp_path / "agent.toml").write_text(card.format("coopenv.policies.give_way:GiveWay") + "[options]\nspeeed = 1\n")
    with pytest.raises(coopenv.CoopenvError, match="speeed"):
        load_agent(str(tmp_path), env.scenario)
