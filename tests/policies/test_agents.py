"""Agents: those that are shipped, own ones, and policies of single vehicles."""

from __future__ import annotations

import json
from functools import cache, partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import coopenv
from coopenv.api.engine import Engine
from coopenv.base.installation import data_directory, list_agents
from coopenv.estimation import Outcome
from coopenv.evaluation import METRICS, drive
from coopenv.policies import act, agents_for, decide, find_agent, load_agent, load_policy, restart
from coopenv.policies.base import played_back
from coopenv.policies.route_follower import RouteFollower
from coopenv.runs.rollouts import rollout
from tests.helpers.env_suite import SHIPPED, rest_slow
from tests.helpers.four_way import FOUR_WAY

PAIRS = [(agent, env) for agent in list_agents() for env in find_agent(agent).environments]


@pytest.mark.parametrize(("agent", "name"), PAIRS)
def test_agent_has_a_card_with_results(agent: str, name: str) -> None:
    folder = data_directory("agents") / agent
    entry = json.loads((folder / "card.json").read_text(encoding="utf-8"))["environments"][name]
    assert set(entry["results"]) == set(METRICS)
    assert entry["command"].startswith(f"coopenv evaluate {name}")
    assert f"| {name} |" in (folder / "card.md").read_text(encoding="utf-8")


batch_of = cache(partial(coopenv.make_vec, num_worlds=2))  # one for all agents of an environment
QUICK = [n for n, pair in enumerate(PAIRS) if pair[1] != "highway_intersection" or pair[0] == "constant_speed"]


@pytest.mark.parametrize(("agent", "name"), rest_slow(PAIRS, *QUICK))
def test_agent_drives(agent: str, name: str) -> None:
    """Actions are within the space, the same for the same seed, and each row's its own affair: a planner's, which
    predicts with each vehicle's camera, each world's."""
    scenario, envs = SHIPPED[name], batch_of(name)
    policy, again, alone = (load_agent(agent, scenario) for _ in range(3))
    by_vehicle = "look_ahead" in agent or agent == "general"
    rows, some = np.arange(envs.num_envs), len(scenario.vehicles) if by_vehicle else 1
    observations, _ = envs.reset(seed=1000)
    for each, count in ((policy, len(rows)), (again, len(rows)), (alone, some)):
        restart(each, np.ones(count, dtype=bool))
    for _ in range(6):
        actions = np.asarray(policy(observations))
        assert envs.action_space.contains(actions.astype(np.float32))
        np.testing.assert_array_equal(again(observations), actions)
        np.testing.assert_allclose(alone(observations[-some:])[-1], actions[-1], atol=1e-5)
        observations, *_ = envs.step(actions)


def test_the_route_follower_arrives_without_touching() -> None:
    scenario = coopenv.load_scenario(FOUR_WAY)
    worlds = range(500, 520)
    engine = Engine(scenario, len(worlds))
    follower, still = (
        drive(engine, policy, worlds)
        for policy in (load_agent("route_follower", scenario), lambda rows: np.tile([-1.0, 0.0], (len(rows), 1)))
    )
    assert not (follower.outcome == Outcome.COLLIDED).any()
    assert (follower.outcome == Outcome.ARRIVED).mean() >= 0.95
    assert still.reward.sum() < follower.reward.sum()


@pytest.mark.parametrize(("top", "reverse"), [(1.0, False), (1.53, False), (2.0, True)])
def test_the_route_follower_drives_at_its_speed_whatever_the_car_can_do(top: float, reverse: bool) -> None:
    overrides = {"dynamics.max_speed": top, "dynamics.reverse": reverse, "observer.name": "robust"}
    scenario = coopenv.load_scenario(FOUR_WAY, overrides)
    for cruise, expected in ((0.6, 0.6), (None, top)):
        trajectory = rollout(scenario, seed=1, policy=RouteFollower(scenario, cruise=cruise), steps=60)
        assert np.abs(trajectory.velocity[:, :, 0]).max() == pytest.approx(expected, abs=0.02)


def test_policies_by_name() -> None:
    scenario = coopenv.load_scenario(FOUR_WAY)
    rows = np.zeros((4, 132), dtype=np.float32)
    assert not load_policy("zero", scenario, 0)(rows).any()
    first, again, other = (load_policy("random", scenario, seed)(rows) for seed in (1, 1, 2))
    assert first.shape == (4, 2) and (first == again).all() and (first != other).any()
    with pytest.raises(coopenv.CoopenvError, match=r"unknown policy 'randm' \(did you mean 'random'\?\)"):
        load_policy("randm", scenario, 0)


CARD = 'title = "x"\ndescription = "y"\nenvironments = ["urban_crossing"]\nentry = "{}"\n'
OWN = """
import numpy as np


class Left:
    def __init__(self, scenario, speed=0.0):
        self.speed = speed

    def __call__(self, observations):
        return np.tile([self.speed, 1.0], (len(observations), 1))


def right(observations):
    return np.tile([0.0, -1.0], (len(observations), 1))
"""


def test_agents_of_ones_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    scenario, rows = coopenv.load_scenario(FOUR_WAY), np.zeros((3, 132), dtype=np.float32)
    folder = tmp_path / "lefty"
    folder.mkdir()
    (folder / "own.py").write_text(OWN)
    (folder / "agent.toml").write_text(CARD.format("own.py:Left") + 'kind = "reference"\n[options]\nspeed = 0.5\n')
    agent = find_agent("lefty")
    assert (agent.name, agent.kind, agent.environments, agent.folder) == (
        *("lefty", "reference", ("urban_crossing",)),
        Path("lefty"),
    )
    monkeypatch.chdir(tmp_path.parent)  # a policy that has been found stays where it was
    np.testing.assert_array_equal(find_agent(folder).policy(scenario)(rows), [[0.5, 1.0]] * 3)
    monkeypatch.chdir(folder)
    np.testing.assert_array_equal(load_policy("own.py:Left", scenario, 0)(rows), [[0.0, 1.0]] * 3)
    np.testing.assert_array_equal(load_policy("own:right", scenario, 0)(rows), [[0.0, -1.0]] * 3)
    assert find_agent("own.py:right").name == "right"
    assert find_agent(folder.rename(tmp_path / "le\x1b[2Jfty")).name == r"le\x1b[2Jfty"  # no terminal obeys it


def test_models_keep_their_memory_by_episode_and_their_normalisation() -> None:
    class Counts:
        """As a recurrent model of Stable-Baselines3: the first entry of an action counts the decisions of a row."""

        def predict(self, rows: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False) -> Any:
            state = np.zeros(len(rows)) if state is None else state
            state = np.where(episode_start, 0.0, state) + 0.1
            return np.column_stack([state, rows[:, 0]]), state

        def get_vec_normalize_env(self) -> Any:
            return SimpleNamespace(normalize_obs=lambda rows: rows - 1.0)

    policy = load_agent(Counts(), "facade")
    rows = np.ones((3, 37))
    np.testing.assert_allclose(policy(rows), [[0.1, 0.0]] * 3)
    restart(policy, np.array([False, True, False]))
    np.testing.assert_allclose(policy(rows)[:, 0], [0.2, 0.1, 0.2])
    restart(policy, np.ones(2, dtype=bool))
    np.testing.assert_allclose(policy(rows[:2]), [[0.1, 0.0]] * 2)


def test_agents_made_for_an_environment() -> None:
    assert "route_follower" in agents_for("urban_crossing")
    assert agents_for("busy_intersection") == []


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("nobody.py:Mine", "no such file"),
        ("own.py:Lft", r"no 'Lft' in .*own\.py \(did you mean 'Left'\?\)"),
        ("own.py:np", "is not a class, nor a function"),
    ],
)
def test_agents_in_code_that_are_none(text: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("own.py").write_text(OWN)
    with pytest.raises(coopenv.CoopenvError, match=message):
        load_policy(text, coopenv.load_scenario(FOUR_WAY), 0)


def test_the_error_of_an_incomplete_agent_names_the_remedy(tmp_path: Path) -> None:
    (tmp_path / "begun").mkdir()
    (tmp_path / "begun" / "checkpoint.safetensors").write_bytes(b"")
    (tmp_path / "mine.py").write_text("class Mine: ...")
    scenario = coopenv.load_scenario("open_square")
    (tmp_path / "empty").mkdir()
    for name, message in (
        ("begun", "unfinished training: go on with .* --resume"),
        ("mine.py", r"mine\.py:Class$"),
        ("empty", "there is no agent.toml in this folder"),
    ):
        with pytest.raises(coopenv.CoopenvError, match=message):
            find_agent(tmp_path / name)
        with pytest.raises(coopenv.CoopenvError, match=message):
            load_policy(str(tmp_path / name), scenario, 0)


def test_bad_agents(tmp_path: Path) -> None:
    scenario = coopenv.load_scenario(FOUR_WAY)
    with pytest.raises(coopenv.CoopenvError, match=r"unknown agent 'routefollower' \(did you mean"):
        load_agent("routefollower", scenario)
    accelerating = coopenv.load_scenario(FOUR_WAY, {"action.longitudinal": "acceleration"})
    with pytest.raises(coopenv.CoopenvError, match=r"agent 'route_follower' cannot be built: it chooses speeds"):
        load_agent("route_follower", accelerating)
    for text, message in (
        ('title = "x"', r"agent\.toml: description: Field required"),
        (CARD.format("RouteFollower"), r"agent\.toml: entry: expected file\.py:Class or package\.module:Class"),
        (CARD.format("coopenv.policies.route_follower:RouteFollower") + "[options]\nspeeed = 1\n", "cannot be built"),
        (CARD.format("x:y") + 'kind = "good"\n', r"kind: Input should be 'learned', 'scripted' or 'reference'"),
        ("title = ", "not valid TOML"),
    ):
        (tmp_path / "agent.toml").write_text(text)
        with pytest.raises(coopenv.CoopenvError, match=message):
            load_agent(tmp_path, scenario)


@pytest.mark.parametrize(
    ("actions", "message"),
    [(np.zeros((2, 3)), r"shape \(2, 3\), expected \(2, 2\)"), ([[0, 0], [0, np.nan]], "not finite for row 1")],
)
def test_actions_that_are_none(actions: np.ndarray, message: str) -> None:
    with pytest.raises(coopenv.CoopenvError, match=message):
        decide(lambda observations: np.asarray(actions), np.zeros((2, 132)))


@pytest.mark.parametrize("observations", [np.zeros((2, 132)), {}, None, {"a": {"b": np.zeros(3)}}, {"a": 1.0}])
def test_observations_of_another_kind(observations: Any) -> None:
    with pytest.raises(coopenv.CoopenvError, match="expected flat observations by agent"):
        act(played_back(np.zeros((1, 2, 2))), observations)


def test_a_policy_with_memory_is_restarted_at_an_episode() -> None:
    class Counting:
        asked = 0

        def reset(self, mask: np.ndarray) -> None:
            assert mask.shape == (4,) and mask.all()
            self.asked = 0

        def __call__(self, observations: np.ndarray) -> np.ndarray:
            self.asked += 1
            return np.zeros((len(observations), 2))

    policy = Counting()
    for _ in range(2):
        rollout(coopenv.load_scenario(FOUR_WAY), policy=policy, steps=3)
    assert policy.asked == 3
