"""Parts of a training: normalisation, cloning, judging, and the exported network beside torch's."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("stable_baselines3", reason="needs the extra 'train'")

import torch
from safetensors.numpy import load_file

import coopenv
from coopenv.api.engine import Engine
from coopenv.api.terms.layout import observation_layout
from coopenv.api.trainers.sb3 import make_sb3_vec_env
from coopenv.evaluation import Result, drive, held_out_seeds, score
from coopenv.policies import Policy, load_agent
from coopenv.policies.network import Network, RightOfWay
from coopenv.scenario import Scenario
from coopenv.scenario.terms import REWARD_TERMS
from coopenv.training.batches import LEAST_VARIANCE, NormalisedEnv
from coopenv.training.command import _finished, train
from coopenv.training.export import export, onnx_model
from coopenv.training.settings import Clone, EvaluationSettings, Ppo, Settings, TrainingPlan, environment_file
from coopenv.training.trainer import Trainer, Watch, watch
from tests.helpers.four_way import FOUR_WAY

pytestmark = pytest.mark.train
torch.set_num_threads(1)
SMALL = Ppo(vehicles=16, decisions=32, epochs=1)


def trainer_of(**settings: object) -> Trainer:
    plan = TrainingPlan(FOUR_WAY, Settings(ppo=SMALL, **settings), seed=0)
    return Trainer(plan, coopenv.load_scenario(FOUR_WAY), threads=1)


@pytest.fixture(scope="module")
def trained() -> Trainer:
    trainer = trainer_of(steps=1024)
    for _ in range(2):
        trainer.update()
    return trainer


def test_numpy_and_onnx_agree_with_torch(trained: Trainer, tmp_path: Path) -> None:
    export(tmp_path, tmp_path, trained, environment_file(FOUR_WAY), [], [])
    observations = np.random.default_rng(0).uniform(-1, 1, (100, 132)).astype(np.float32)
    expected = trained.model.predict(trained.env.normalise(observations), deterministic=True)[0]
    agent = load_agent(tmp_path, trained.scenario)
    assert isinstance(agent, Network)
    assert agent(observations) == pytest.approx(expected, abs=1e-5)
    reference = pytest.importorskip("onnx.reference", reason="needs the extra 'onnx'")
    data = onnx_model(load_file(tmp_path / "weights.safetensors"), trained.plan.settings.ppo.observation_clip)
    (tmp_path / "policy.onnx").write_bytes(data)
    model = reference.ReferenceEvaluator(str(tmp_path / "policy.onnx"))
    assert model.run(None, {"observation": observations})[0] == pytest.approx(expected, abs=1e-5)


def test_statistics_are_those_of_vehicles_under_way() -> None:
    env = NormalisedEnv(make_sb3_vec_env(FOUR_WAY, num_worlds=2, seed=0), Ppo())
    twin = make_sb3_vec_env(FOUR_WAY, num_worlds=2, seed=0)
    env.reset()
    seen = [twin.reset()]
    actions = np.column_stack([np.ones(8), np.linspace(0.2, 0.5, 8)]).astype(np.float32)  # walls, one after another
    for _ in range(100):
        normalised, rewards, dones, infos = env.step(actions)
        raw, plain, _, plain_infos = twin.step(actions)
        seen.append(raw[twin.acted])
        assert rewards == pytest.approx(0.1 * plain)
        for row in np.flatnonzero(dones):
            assert infos[row]["episode"]["r"] == pytest.approx(plain_infos[row]["episode"]["r"])
            assert np.array_equal(
                infos[row]["terminal_observation"], env.normalise(plain_infos[row]["terminal_observation"])
            )
    assert not twin.acted.all()
    rows = np.concatenate(seen)
    assert env.statistics.mean == pytest.approx(rows.mean(axis=0), abs=1e-4)
    expected = np.clip((raw - rows.mean(axis=0)) / np.sqrt(rows.var(axis=0) + LEAST_VARIANCE), -6.0, 6.0)
    assert normalised == pytest.approx(expected, abs=1e-2)


def test_rewards_are_scaled_by_the_running_spread_of_returns() -> None:
    env = NormalisedEnv(make_sb3_vec_env(FOUR_WAY, num_worlds=2, seed=0), Ppo(reward_scale="spread", gamma=0.9))
    twin, seen = make_sb3_vec_env(FOUR_WAY, num_worlds=2, seed=0), list[float]()
    env.reset(), twin.reset()
    rewards = [list[float]() for _ in range(8)]  # of the episodes under way
    actions = np.column_stack([np.ones(8), np.linspace(0.2, 0.5, 8)]).astype(np.float32)
    for step in range(60):
        _, scaled, dones, _ = env.step(actions)
        plain = twin.step(actions)[1]
        for row, value in enumerate(plain):
            rewards[row].append(value)
            if twin.acted[row]:
                seen.append(sum(0.9**k * reward for k, reward in enumerate(rewards[row][::-1])))
            if dones[row]:
                rewards[row].clear()
        assert scaled == pytest.approx(plain / np.std(seen), rel=1e-2) or step < 10  # SB3's mean begins with a prior
    assert len(rewards[7]) < 60


def test_every_vehicle_counts_once_however_short_its_episodes() -> None:
    """The first crashes three times until the second arrives: one of the two has arrived, not one of four episodes."""
    env = SimpleNamespace(num_envs=3, acted=np.array([True, True, False]))
    env.batch_infos = {"time": np.zeros(3), "position_error": np.zeros(3)}
    watch = Watch(env)
    ends = [{"outcome": name, "episode": {"r": value}} for name, value in (("collided", -20.0), ("arrived", 10.0))]
    for dones in ([True, False], [True, False], [True, True]):
        assert "return" not in watch.figures(), "the second is still under way"
        watch.locals = {"dones": np.array([*dones, False]), "infos": [*ends, {}]}
        watch._on_step()
    env.acted[2] = True  # it was absent until now
    watch.locals["dones"][:] = False
    watch._on_step()
    assert watch.figures() == {"return": -5.0, "arrival_rate": 0.5, "collision_rate": 0.5}


def test_a_rule_limits_the_speeds_of_training_and_agent(tmp_path: Path) -> None:
    settings = Settings(ppo=SMALL, steps=1024, right_of_way=True)
    trainer = Trainer(TrainingPlan("open_square", settings, 0), coopenv.load_scenario("open_square"), threads=1)
    trainer.begin()
    trainer.update()
    rows = trainer.batch.engine.view("observation").reshape(16, -1).copy()
    free = np.asarray(trainer.model.predict(trainer.env.normalise(rows), deterministic=True)[0])
    full = np.tile(np.float32([1.0, 0.0]), (16, 1))
    rule = RightOfWay(trainer.scenario)
    assert trainer.driver()(rows) == pytest.approx(rule(rows, free))
    limits = rule(rows, full)[:, 0]
    trainer.env.step_async(full)
    assert np.array_equal(trainer.batch._actions[:, 0], limits)
    export(tmp_path, tmp_path, trainer, environment_file("open_square"), [], [])
    agent = load_agent(tmp_path, trainer.scenario)
    assert agent(rows) == pytest.approx(trainer.driver()(rows), abs=1e-5)
    assert agent.agents == list(trainer.scenario.vehicle_names)


def test_the_critic_of_a_clone_learns_alone_at_first() -> None:
    """The policy moves when the critic explains enough, or after a quarter of the steps; what it sees stays scaled."""
    clone = Clone(agent="route_follower", episodes=2, epochs=1)
    settings = Settings(ppo=SMALL.model_copy(update={"critic_first": 0.999}), steps=8 * 512, clone=clone)
    trainer = Trainer(TrainingPlan(FOUR_WAY, settings, 0), coopenv.load_scenario(FOUR_WAY), threads=1)
    trainer.begin()
    states = [trainer.tensors()]
    for _ in range(3):
        trainer.update()
        states.append(trainer.tensors())
    for name in ("layers.0.weight", "layers.2.bias", "log_std"):
        moved = [not np.array_equal(a[name], b[name]) for a, b in pairwise(states)]
        assert moved == [False, False, True], name
    assert not any(
        np.array_equal(a["critic.layers.0.weight"], b["critic.layers.0.weight"]) for a, b in pairwise(states)
    )
    assert np.array_equal(states[0]["observation.mean"], states[-1]["observation.mean"])
    short = trainer_of(steps=300, clone=clone)
    short.begin()
    before = short.tensors()["layers.0.weight"]
    short.update()
    assert not np.array_equal(short.tensors()["layers.0.weight"], before), "a training of one rollout learns, too"
    explaining = trainer_of(steps=8 * 512, clone=clone)
    explaining.begin()
    explaining.model.explained = 1.0
    assert explaining.model.critic_alone
    explaining.model.train = lambda: None
    explaining.update()
    assert not explaining.model.critic_alone


def test_after_the_first_round_the_clone_drives() -> None:
    """A clone that stands stays where it starts, and the driver's actions would have led on."""
    scenario, standing = coopenv.load_scenario(FOUR_WAY), lambda rows: np.tile([-1.0, 0.0], (len(rows), 1))
    settings = Clone(agent="route_follower", noise=0.0)
    driven, actions, *_ = watch(scenario, 2, settings, 0.99, 0, 1, lambda line: None)
    stood, meant, *_ = watch(scenario, 2, settings, 0.99, 0, 1, lambda line: None, clone=standing)
    forward = observation_layout(scenario)["velocity"].start
    assert driven[:, forward].mean() > 10 * abs(stood[:, forward].mean())
    assert meant[:8] == pytest.approx(actions[:8]) and meant[0, 0] > 0.0, "of the first step, before anything has moved"
    seen: list[object] = []
    trainer = trainer_of(steps=512, clone=Clone(agent="route_follower", episodes=4, rounds=2, epochs=1))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "coopenv.training.trainer.watch",
            lambda *given: (seen.append((given[1], given[4], given[-1])), watch(*given))[1],
        )
        trainer.begin()
    assert [(worlds, clone is not None) for worlds, _, clone in seen] == [(2, False), (2, True)]
    assert len({seed for _, seed, _ in seen}) == 2, "other worlds"


@pytest.mark.parametrize("broken", ["weights", "exploration"])
def test_a_policy_that_is_not_finite_is_one_error_line(broken: str) -> None:
    trainer = trainer_of(steps=1024)
    policy = trainer.model.policy
    with torch.no_grad():
        if broken == "weights":
            policy.value_net.weight[:] = torch.nan  # which no action shows
        else:
            policy.log_std[:] = -1e9  # finite, but it draws nothing
    with pytest.raises(coopenv.CoopenvError, match=r"diverged: after 0 steps .* ppo\.learning_rate = 0\.001"):
        trainer.driver()(np.zeros((1, 132), dtype=np.float32))


def figures_of(policy: Policy, scenario: Scenario) -> dict[str, Result]:
    results = score(drive(Engine(scenario, 8), policy, held_out_seeds(0, 8)))
    return {result.metric: result for result in results}


@pytest.mark.slow
def test_a_clone_drives_like_its_model() -> None:
    trainer = trainer_of(steps=1024, clone=Clone(agent="route_follower", episodes=16, epochs=40))
    scenario = trainer.scenario

    def mean_action(observations: np.ndarray) -> np.ndarray:
        return trainer.model.predict(trainer.env.normalise(observations), deterministic=True)[0]

    before = figures_of(mean_action, scenario)
    lines: list[str] = []
    trainer.begin(lines.append)
    assert lines[0] == f"watching route_follower: 0 of {scenario.horizon:g} s"
    assert lines[-40] == "learning from route_follower: pass 1 of 40"
    assert len(lines) - 40 <= scenario.horizon * scenario.rates.decision  # one per decision
    after = figures_of(mean_action, scenario)
    model = figures_of(load_agent("route_follower", scenario), scenario)
    assert before["arrival_rate"].mean < 0.4 and model["arrival_rate"].mean == 1.0
    assert after["arrival_rate"].mean > 0.6
    observation, _ = trainer.batch.envs.reset(seed=0)
    with torch.no_grad():
        value = trainer.model.policy.predict_values(torch.from_numpy(trainer.env.normalise(observation)))
    assert 0.0 < float(value.mean()) < 3.0  # a tenth of what route_follower earns, discounted


@pytest.mark.slow
def test_learns_to_drive_faster_where_nothing_else_counts(tmp_path: Path) -> None:
    """Progress alone is paid and nothing ends an episode: the mean action goes from half speed towards full speed."""
    overrides = {
        "horizon": 5.0,
        "reward.weights": {**dict.fromkeys(REWARD_TERMS.built_in, 0.0), "progress": 1.0},
        "termination": {"collision": False, "arrival": False},
    }
    ppo = Ppo(vehicles=64, decisions=16, gamma=0.9, learning_rate=3e-3)
    settings = Settings(steps=40_000, scenario=overrides, ppo=ppo, evaluation=EvaluationSettings(final_worlds=8))
    results = train(TrainingPlan(FOUR_WAY, settings, seed=2), tmp_path / "agent", threads=1)
    figures = {result.metric: result for result in results}
    scenario = coopenv.load_scenario(FOUR_WAY, overrides)
    half_speed = figures_of(lambda observations: np.zeros((len(observations), 2)), scenario)
    assert figures["return"].ci_low > half_speed["return"].ci_high


def test_an_agent_of_a_longer_action_is_not_this_one(trained: Trainer, tmp_path: Path) -> None:
    export(tmp_path, tmp_path, trained, environment_file(FOUR_WAY), [], [])
    text = (
        (tmp_path / "agent.toml")
        .read_text()
        .replace(
            "[network.action]",
            "[network.action]\npan = {start=2, stop=3, low=-1, high=1, scale=1, center=0, unit='rad'}",
        )
    )
    (tmp_path / "agent.toml").write_text(text)
    with pytest.raises(coopenv.CoopenvError, match="another action: 'pan' is not in this environment"):
        load_agent(tmp_path, trained.scenario)


@pytest.mark.parametrize(("alone", "drives"), [(None, False), ("constant_speed", True)])
def test_the_judged_driver_is_the_one_that_the_agent_is(alone: str | None, drives: bool) -> None:
    """Where a vehicle receives no message, it is that of the key `alone`."""
    scenario = coopenv.load_scenario("lighthouse")
    trainer = Trainer(TrainingPlan("lighthouse", Settings(ppo=SMALL, alone=alone), seed=0), scenario, threads=1)
    for layers in trainer.model.policy.layers():
        torch.nn.init.zeros_(layers[-1].weight), torch.nn.init.constant_(layers[-1].bias, -2.0)
    driver = _finished(trainer)
    seen = np.zeros((2, observation_layout(scenario).size), dtype=np.float32)
    actions = [driver(seen) for _ in range(round(scenario.rates.decision) + 1)]
    assert (actions[0] == -1.0).all() and (actions[-1] != -1.0).any() == drives
