"""Letters in place of steering: the update beside SB3's, clones, checkpoints, exported agents, and what is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("stable_baselines3", reason="needs the extra 'train'")

import torch
from stable_baselines3 import PPO
from stable_baselines3.common.policies import ActorCriticPolicy

import coopenv
from coopenv.api.trainers.sb3 import ActingRowsBuffer
from coopenv.base.errors import CoopenvError
from coopenv.policies import load_agent
from coopenv.policies.choice_rows import ChoiceRows
from coopenv.policies.choices import Choices, choices_of
from coopenv.policies.loader import read_card
from coopenv.training.command import Course, Reports, possible, read, restore, save, train
from coopenv.training.export import check_onnx, export
from coopenv.training.ranking import Ranking
from coopenv.training.settings import Clone, EvaluationSettings, Ppo, Settings, TrainingPlan, environment_file
from coopenv.training.trainer import Trainer
from examples.two_streets.oldest_sight import OldestSight

pytestmark = pytest.mark.train
torch.set_num_threads(1)
SCENE = "lighthouse"
SEEN = (*coopenv.load_scenario(SCENE).observation.include, "seen")
SMALL = Ppo(vehicles=12, decisions=16, epochs=1, minibatches=2, hidden=(32, 32))
RULE = "examples/two_streets/oldest_sight.py:OldestSight"
OWN = """
import numpy as np

from coopenv.policies.choices import Choices


class Slow(Choices):
    def choose(self, observations, present):
        return np.ones(len(observations), dtype=int)  # half of the top speed


class Fewer(Choices):
    def __init__(self, scenario):
        super().__init__(scenario)
        self.alphabet = self.alphabet[:2]
"""


def plan_of(horizon: float = 6.0, **settings: Any) -> TrainingPlan:
    overrides = {"horizon": horizon, "observation.include": SEEN}
    given = {"ppo": SMALL, "steps": 4096, "actions": "choices", "scenario": overrides} | settings
    return TrainingPlan(SCENE, Settings(**given), seed=0)


def trainer_of(kind: type[Trainer] = Trainer, **settings: Any) -> Trainer:
    plan = plan_of(**settings)
    return kind(plan, coopenv.load_scenario(SCENE, plan.all_overrides), threads=1)


class Original(Trainer):
    """The same training with SB3's own classes."""

    kinds = (PPO, ActorCriticPolicy, ActingRowsBuffer)


def shaken(trainer: Trainer, size: float = 0.05) -> None:
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for values in trainer.model.policy.parameters():
            values += size * torch.randn(values.shape, generator=generator)


@pytest.mark.parametrize("ppo", [{}, {"entropy": 0.05, "clip": 0.01, "max_gradient": 0.05}])
def test_an_update_on_letters_is_that_of_sb3(ppo: dict[str, Any]) -> None:
    trainers, starts = [], []
    for kind in (Trainer, Original):
        trainer = trainer_of(kind, ppo=SMALL.model_copy(update={"epochs": 3, **ppo}))
        starts.append({name: values.clone() for name, values in trainer.model.policy.state_dict().items()})
        trainer.begin()
        trainer.update()
        trainer.update()
        trainers.append(trainer)
    lean, original = (trainer.model for trainer in trainers)
    assert np.array_equal(lean.rollout_buffer.actions, original.rollout_buffer.actions)
    assert len(np.unique(lean.rollout_buffer.actions)) == lean.action_space.n, "all letters are explored"
    for name, theirs in original.policy.state_dict().items():
        change = float((theirs - starts[0][name]).abs().max())
        assert change > 1e-4, name
        assert lean.policy.state_dict()[name].numpy() == pytest.approx(theirs.numpy(), abs=0.01 * change), name
    assert "log_std" not in starts[0]


def test_the_derivatives_of_a_memory_are_torchs_where_letters_are_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    trainer = trainer_of(ppo=SMALL.model_copy(update={"memory": 8, "entropy": 0.1}))
    model, width = trainer.model, 8
    shaken(trainer)
    trainer.begin()
    with monkeypatch.context() as without:
        without.setattr(model, "train", lambda: None)
        trainer.update()
    shaken(trainer)
    model.max_grad_norm = 1e9
    monkeypatch.setattr(model.policy.optimizer, "step", lambda: None)
    model.batch_size = 1_000_000  # a single minibatch
    model.train()
    found = {name: values.grad for name, values in model.policy.named_parameters()}
    model.policy.zero_grad()
    rows = model.rollout_buffer._get_samples(np.flatnonzero(model.rollout_buffer.acted.T))
    model.rollout_buffer.present = np.arange(12)
    every, acted, starts = (torch.from_numpy(values) for values in model.rollout_buffer.sequences())
    states = model.policy.remember(every, starts)[acted]
    seen = torch.cat([rows.observations[:, :-width], states], dim=1)
    values, density, entropy = ActorCriticPolicy.evaluate_actions(model.policy, seen, rows.actions.long().flatten())
    advantages = (rows.advantages - rows.advantages.mean()) / (rows.advantages.std() + 1e-8)
    ratio = torch.exp(density - rows.old_log_prob)
    gain = torch.minimum(advantages * ratio, advantages * ratio.clamp(0.8, 1.2)).mean()
    loss = 0.5 * (values.flatten() - rows.returns).square().mean() - gain - 0.1 * entropy.mean()
    loss.backward()
    for name, parameter in model.policy.named_parameters():
        assert parameter.grad.abs().max() > 1e-6, name
        assert found[name].numpy() == pytest.approx(parameter.grad.numpy(), rel=1e-3, abs=1e-5), name


def test_the_discount_is_that_of_the_decisions_of_a_letter() -> None:
    trainer = trainer_of(ppo=SMALL.model_copy(update={"gamma": 0.99}))
    kept = Choices(trainer.scenario).kept
    assert kept == 5 and trainer.gamma == trainer.model.gamma == pytest.approx(0.99**kept)
    assert trainer.env._gamma == trainer.gamma


@pytest.mark.parametrize("memory", [None, 8])
def test_a_resumed_training_on_letters_is_the_uninterrupted_one(memory: int | None, tmp_path: Path) -> None:
    """Episodes end in the middle of a rollout, and senders of messages are remembered by the driver below."""
    settings = {"ppo": SMALL.model_copy(update={"memory": memory}), "horizon": 9.2}
    whole = trainer_of(**settings)
    whole.begin()
    whole.update()
    save(tmp_path / "checkpoint.safetensors", whole, Course())
    whole.update()
    again = trainer_of(**settings)
    restore(read(tmp_path / "checkpoint.safetensors"), again)
    driver = again.batch.envs.driver
    assert driver._reported[0].any(), "messages of before"
    again.update()
    for name, values in whole.tensors().items():
        assert again.tensors()[name] == pytest.approx(values, abs=1e-5), name


def test_a_clone_of_a_rule_chooses_its_letters(tmp_path: Path) -> None:
    """In worlds that it has not learnt from, and as an exported agent in NumPy."""
    clone = Clone(agent=RULE, episodes=48, rounds=2, epochs=25, smoothing=0.2)
    trainer = trainer_of(clone=clone, steps=0, horizon=20.0)
    trainer.begin()
    export(tmp_path, tmp_path, trainer, environment_file(SCENE), [], [])
    student, rule = load_agent(tmp_path, trainer.scenario), OldestSight(trainer.scenario)
    assert read_card(tmp_path).training["teacher"] == RULE
    rows = ChoiceRows(coopenv.make_vec(trainer.scenario, num_worlds=8, autoreset="disabled"), rule)
    observations, _ = rows.reset(seed=77)
    theirs, mine = [], []
    for _ in range(36):
        theirs.append(rule.letters(observations))
        mine.append(choices_of(student).letters(observations))
        observations, *_ = rows.step(theirs[-1])
    served = np.stack(theirs) >= rule.first_served
    assert 0.1 < served.mean() < 0.9
    assert (np.stack(mine) == np.stack(theirs)).mean() > 0.99


def test_an_exported_agent_remembers_once_per_letter(tmp_path: Path) -> None:
    """Rows whose letters begin at different times do not disturb one another."""
    trainer = trainer_of(ppo=SMALL.model_copy(update={"memory": 8}))
    trainer.begin()
    trainer.update()
    shaken(trainer, 0.3)
    export(tmp_path, tmp_path, trainer, environment_file(SCENE), [], [])
    agent, driver = load_agent(tmp_path, trainer.scenario), trainer.driver()
    env = coopenv.make_vec(trainer.scenario, num_worlds=4, autoreset="disabled")
    observations, _ = env.reset(seed=2)
    late, states, letters = np.arange(8) >= 4, [np.zeros((8, 8))], list[np.ndarray]()
    for decision in range(24):
        if decision == 12:  # a new episode begins in the middle of a letter
            agent.reset(late)
        actions = agent(observations)
        if decision < 12:
            assert driver(observations) == pytest.approx(actions, abs=1e-4)
        states.append(agent._memory.state.copy())
        letters.append(choices_of(agent).memory(observations)[1].copy())
        changed = (states[-1] != states[-2]).any(axis=1)
        begins = np.where(late & (decision >= 12), (decision - 12) % 5 == 0, decision % 5 == 0)
        assert np.array_equal(changed, begins), decision
        observations, *_ = env.step(actions)
    assert len(np.unique(np.stack(letters))) > 2


def test_ppo_on_letters_improves_a_bad_start(tmp_path: Path) -> None:
    """A clone that drives at half of the top speed learns to hurry, where nothing but progress is paid."""
    (tmp_path / "own.py").write_text(OWN)
    clone = Clone(agent=f"{tmp_path / 'own.py'}:Slow", episodes=64, epochs=60, smoothing=0.3)
    weights = dict.fromkeys(coopenv.load_scenario(SCENE).reward.by_name, 0.0) | {"progress": 1.0}
    ppo = SMALL.model_copy(update={"vehicles": 48, "critic_first": 0.0, "gamma": 0.9, "epochs": 4})
    trainer = trainer_of(clone=clone, ppo=ppo, steps=100_000)
    paid = {f"reward.weights.{name}": value for name, value in weights.items()}
    plan = TrainingPlan(SCENE, trainer.plan.settings, 0, overrides=paid)
    trainer = Trainer(plan, possible(plan), threads=1)
    trainer.begin()
    rows = np.asarray(trainer.batch.engine.view("observation")).reshape(48, -1)
    assert (trainer.driver().choices.letters(rows) == 1).all()
    returns = []
    for _ in range(12):
        trainer.update()
        returns.append(trainer.status.figures.get("return", np.nan))
    assert returns[-1] > 1.1 * returns[0] > 0.0


def test_of_several_teachers_the_best_is_cloned_and_named(tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(OWN)
    slow = f"{tmp_path / 'own.py'}:Slow"
    evaluation = EvaluationSettings(worlds=6, final_worlds=2, drivers=())
    clone = Clone(agent=(slow, RULE), episodes=2, epochs=1)
    plan = plan_of(steps=0, clone=clone, evaluation=evaluation, horizon=30.0)
    found: list[Ranking] = []
    train(plan, tmp_path / "agent", threads=1, reports=Reports(ranked=found.append))
    card = read_card(tmp_path / "agent")
    assert card.training["teacher"] == RULE and card.description.startswith(f"Clone of {RULE}")
    assert found[0].notes == (f"Cloned: {RULE}, the best of 2 agents in the worlds for validation",)


def test_a_teacher_with_other_letters_is_refused(tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(OWN)
    with pytest.raises(CoopenvError, match=r"clone\.agent: .*Fewer does not choose letters of actions = 'choices'"):
        possible(plan_of(clone=Clone(agent=f"{tmp_path / 'own.py'}:Fewer")))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"actions": "letters"}, r"actions\n  Input should be 'steering' or 'choices'"),
        ({"right_of_way": True}, r"actions: choices keep the right of way already"),
        ({"clone": Clone(agent="route_follower")}, r"clone\.agent: route_follower does not choose letters of actions"),
        ({"start": "lighthouse_team"}, r"start: lighthouse_team chooses other actions than actions = 'choices'"),
        ({"actions": "steering", "scenario": {"observation.exclude": ["messages"]}, "alone": "peek"}, "message_mask"),
        ({"scenario": {"observation.exclude": ["messages"]}}, r"the observation lacks message_position"),
    ],
)
def test_mistakes_are_one_line(settings: dict[str, Any], message: str) -> None:
    with pytest.raises((CoopenvError, ValueError), match=message):
        possible(plan_of(**settings))


def test_letters_have_no_onnx_model() -> None:
    with pytest.raises(CoopenvError, match=r"--onnx: not with actions = 'choices'"):
        check_onnx(Settings(actions="choices"))
