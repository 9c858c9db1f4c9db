"""Parts of a training: normalisation, cloning, judging, and the exported network beside torch's."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("stable_baselines3", reason="needs the extra 'train'")

import torch

import coopenv
from coopenv.api.trainers.sb3 import make_sb3_vec_env
from coopenv.policies import load_agent
from coopenv.policies.network import Network
from coopenv.scenario.terms import REWARD_TERMS
from coopenv.training.command import train
from coopenv.training.export import export, network_of, onnx_model
from coopenv.training.judging import judge
from coopenv.training.normalised import LEAST_VARIANCE, NormalisedEnv
from coopenv.training.settings import Clone, Evaluation, Plan, Ppo, Settings
from coopenv.training.trainer import Trainer

pytestmark = pytest.mark.train
torch.set_num_threads(1)
SMALL = Ppo(worlds=4, decisions=32, epochs=1)


def trainer_of(**settings: object) -> Trainer:
    plan = Plan("urban_crossing", Settings(ppo=SMALL, **settings), seed=0)
    return Trainer(plan, coopenv.load_scenario("urban_crossing"), threads=1)


@pytest.fixture(scope="module")
def trained() -> Trainer:
    trainer = trainer_of(steps=1024)
    for _ in range(2):
        trainer.update()
    return trainer


def test_numpy_and_onnx_agree_with_torch(trained: Trainer, tmp_path: Path) -> None:
    export(tmp_path, trained, {}, [])
    observations = np.random.default_rng(0).uniform(-1, 1, (100, 132)).astype(np.float32)
    expected = trained.model.predict(trained.env.normalise(observations), deterministic=True)[0]
    agent = load_agent(tmp_path, trained.scenario)
    assert isinstance(agent, Network)
    assert agent(observations) == pytest.approx(expected, abs=1e-5)
    reference = pytest.importorskip("onnx.reference", reason="needs the extra 'onnx'")
    data = onnx_model(network_of(trained), trained.plan.settings.ppo.observation_clip)
    (tmp_path / "policy.onnx").write_bytes(data)
    model = reference.ReferenceEvaluator(str(tmp_path / "policy.onnx"))
    assert model.run(None, {"observation": observations})[0] == pytest.approx(expected, abs=1e-5)


def test_statistics_are_those_of_vehicles_under_way() -> None:
    env = NormalisedEnv(make_sb3_vec_env("urban_crossing", num_worlds=2, seed=0), clip=6.0, reward_scale=0.1)
    twin = make_sb3_vec_env("urban_crossing", num_worlds=2, seed=0)
    env.reset()
    seen = [twin.reset()]
    actions = np.column_stack([np.ones(8), np.linspace(0.2, 0.5, 8)]).astype(np.float32)  # walls, one after another
    for _ in range(100):
        normalised, rewards, dones, infos = env.step(actions)
        raw, plain, _, told = twin.step(actions)
        seen.append(raw[twin.acted])
        assert rewards == pytest.approx(0.1 * plain)
        for row in np.flatnonzero(dones):
            assert infos[row]["episode"]["r"] == pytest.approx(told[row]["episode"]["r"])
            assert np.array_equal(infos[row]["terminal_observation"], env.normalise(told[row]["terminal_observation"]))
    assert not twin.acted.all()
    rows = np.concatenate(seen)
    assert env.statistics.mean == pytest.approx(rows.mean(axis=0), abs=1e-4)
    expected = np.clip((raw - rows.mean(axis=0)) / np.sqrt(rows.var(axis=0) + LEAST_VARIANCE), -6.0, 6.0)
    assert normalised == pytest.approx(expected, abs=1e-2)


@pytest.mark.slow
def test_a_clone_drives_like_its_model() -> None:
    trainer = trainer_of(steps=1024, clone=Clone(agent="give_way", episodes=16, epochs=40))
    scenario = trainer.scenario
    before = judge(lambda o: trainer.model.predict(trainer.env.normalise(o), deterministic=True)[0], scenario, "x", 8)
    trainer.begin()
    after = judge(lambda o: trainer.model.predict(trainer.env.normalise(o), deterministic=True)[0], scenario, "x", 8)
    model = judge(load_agent("give_way", scenario), scenario, "x", 8)
    assert before["arrival_rate"].mean < 0.4 and model["arrival_rate"].mean == 1.0
    assert after["arrival_rate"].mean > 0.6
    observation, _ = trainer.batch.envs.reset(seed=0)
    value = trainer.model.policy.predict_values(torch.from_numpy(trainer.env.normalise(observation)))
    assert 0.0 < float(value.mean()) < 3.0  # a tenth of what give_way earns, discounted


def test_judging_by_hand() -> None:
    """A driver that stands still: nobody arrives or collides, and the error is that of the world stepped by hand."""
    scenario = coopenv.load_scenario("urban_crossing", {"horizon": 5.0})
    figures = judge(lambda o: np.tile([-1.0, 0.0], (len(o), 1)), scenario, "x", worlds=3)
    env = coopenv.make_vec("urban_crossing", num_worlds=3, overrides={"horizon": 5.0}, autoreset="disabled")
    env.reset(seed=2**31)
    returned, errors = np.zeros(env.num_envs), []
    for _ in range(50):
        _, rewards, _, _, infos = env.step(np.tile(np.float32([-1.0, 0.0]), (env.num_envs, 1)))
        returned += rewards
        if infos["time"][0] > 3.0:
            errors.append(infos["position_error"])
    assert figures["arrival_rate"].mean == figures["collision_rate"].mean == 0.0
    assert figures["return"].mean == pytest.approx(returned.mean(), abs=1e-4)
    assert figures["e95_m"].mean == pytest.approx(np.percentile(errors, 95), rel=1e-5)
    assert figures["e50_m"].ci_low <= figures["e50_m"].mean <= figures["e50_m"].ci_high
    assert np.isnan(figures["travel_time_s"].mean)


@pytest.mark.slow
def test_learns_to_drive_faster_where_nothing_else_counts(tmp_path: Path) -> None:
    """Progress alone is paid and nothing ends an episode: the mean action goes from half speed towards full speed."""
    overrides = {
        "horizon": 5.0,
        "reward.weights": {**dict.fromkeys(REWARD_TERMS.built_in, 0.0), "progress": 1.0},
        "termination": {"collision": False, "arrival": False},
    }
    ppo = Ppo(worlds=16, decisions=16, gamma=0.9, learning_rate=3e-3)
    settings = Settings(steps=40_000, scenario=overrides, ppo=ppo, evaluation=Evaluation(final_worlds=8))
    figures = train(Plan("urban_crossing", settings, seed=2), tmp_path / "agent", threads=1)
    scenario = coopenv.load_scenario("urban_crossing", overrides)
    half_speed = judge(lambda o: np.zeros((len(o), 2)), scenario, "x", 8)
    assert figures["return"].ci_low > half_speed["return"].ci_high


def test_an_agent_of_a_longer_action_is_not_this_one(trained: Trainer, tmp_path: Path) -> None:
    export(tmp_path, trained, {}, [])
    text = (
        (tmp_path / "agent.toml")
        .read_text()
        .replace("[network.action]", "[network.action]\npan = {start=2, stop=3, low=-1, high=1, scale=1, unit='rad'}")
    )
    (tmp_path / "agent.toml").write_text(text)
    with pytest.raises(coopenv.CoopenvError, match="another action: 'pan' is not in this environment"):
        load_agent(tmp_path, trained.scenario)
