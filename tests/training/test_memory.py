"""PPO with a memory: its derivatives beside torch's, what it forgets, checkpoints, and the exported agent."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("stable_baselines3", reason="needs the extra 'train'")

import torch
from torch.distributions import Normal

import coopenv
from coopenv.api.trainers.sb3 import LeanPpo
from coopenv.policies import load_agent
from coopenv.policies.memory import MEMORY
from coopenv.training.command import Course, read, restore, save
from coopenv.training.export import check_onnx, export
from coopenv.training.settings import Clone, Ppo, Settings, TrainingPlan, environment_file, read_settings
from coopenv.training.trainer import Trainer
from tests.helpers.four_way import FOUR_WAY

pytestmark = pytest.mark.train
torch.set_num_threads(1)
WIDTH = 8
PPO = Ppo(vehicles=16, decisions=64, epochs=1, minibatches=2, hidden=(16, 16), memory=WIDTH)


def trainer_of(**settings: object) -> Trainer:
    overrides = {"horizon": 8.0}  # episodes end in the middle of a rollout
    plan = TrainingPlan(FOUR_WAY, Settings(**{"ppo": PPO, "steps": 4096, "scenario": overrides} | settings), seed=0)
    return Trainer(plan, coopenv.load_scenario(FOUR_WAY, overrides), threads=1)


def shaken(trainer: Trainer) -> None:
    """Change all parameters, so that what is remembered counts, and densities are not those of the rollout."""
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for values in trainer.model.policy.parameters():
            values += 0.05 * torch.randn(values.shape, generator=generator)


def loss_of(model: LeanPpo, clip: float) -> torch.Tensor:
    """Return PPO's loss of a minibatch as torch computes it, states row by row and step by step."""
    policy, buffer = model.policy, model.rollout_buffer
    total, advantages = [], []
    for row in np.asarray(buffer.present):
        state = torch.zeros(WIDTH)
        for t in range(buffer.buffer_size):
            at = row * buffer.buffer_size + t
            seen = torch.from_numpy(buffer.observations[at, :-WIDTH])
            parked = t > 0 and not buffer.acted[t - 1, row]
            if buffer.episode_starts[t, row] or parked:
                state = torch.zeros(WIDTH)
            stored = torch.from_numpy(buffer.observations[at, -WIDTH:])
            state = stored if t == 0 else policy.cell(seen, state)
            if not buffer.acted[t, row]:
                continue
            both = torch.cat([seen, state])
            mean = policy.action_net(policy.mlp_extractor.policy_net(both))
            value = policy.value_net(policy.mlp_extractor.value_net(both))[0]
            density = Normal(mean, policy.log_std.exp()).log_prob(torch.from_numpy(buffer.actions[at])).sum()
            total.append((density - float(buffer.log_probs[at, 0]), value - float(buffer.returns[at, 0])))
            advantages.append(float(buffer.advantages[at, 0]))
    scaled = torch.tensor(advantages)
    scaled = (scaled - scaled.mean()) / (scaled.std() + 1e-8)
    ratio = torch.stack([change for change, _ in total]).exp()
    gain = torch.minimum(scaled * ratio, scaled * ratio.clamp(1.0 - clip, 1.0 + clip)).mean()
    return model.vf_coef * torch.stack([excess for _, excess in total]).square().mean() - gain


@pytest.mark.parametrize("alone", [False, True])
def test_derivatives_are_torchs_through_time(alone: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """While the critic learns alone, neither policy nor memory do."""
    trainer = trainer_of()
    model = trainer.model
    assert isinstance(model, LeanPpo)
    shaken(trainer)
    with torch.no_grad():
        model.policy.action_net.bias[:] = torch.tensor([1.0, 0.4])  # into the walls
    trainer.begin()
    with monkeypatch.context() as without:
        without.setattr(model, "train", lambda: None)
        trainer.update()
    shaken(trainer)
    model.critic_alone, model.max_grad_norm = alone, 1e9
    monkeypatch.setattr(model.policy.optimizer, "step", lambda: None)
    model.batch_size = 1_000_000  # a single minibatch
    assert 0 < model.rollout_buffer.acted.sum() < model.rollout_buffer.acted.size, "some have ended"
    model.train()
    found = {name: values.grad for name, values in model.policy.named_parameters()}
    model.policy.zero_grad()
    loss_of(model, 0.2).backward()
    for name, values in model.policy.named_parameters():
        if alone and "value" not in name:
            assert found[name] is None, name
        else:
            assert values.grad.abs().max() > 1e-6, name
            assert found[name].numpy() == pytest.approx(values.grad.numpy(), rel=1e-3, abs=1e-5), name


def test_what_rollouts_remember_is_of_the_present_episode_alone() -> None:
    trainer = trainer_of()
    env = trainer.remembering
    assert env is not None
    seen, cell = env.reset(), env.cell
    state = np.zeros((env.num_envs, WIDTH), dtype=np.float32)
    actions = np.column_stack([np.ones(16), np.linspace(0.2, 0.5, 16)]).astype(np.float32)  # walls, one after another
    for _ in range(60):
        with torch.no_grad():
            state = cell(torch.from_numpy(seen[:, :-WIDTH].copy()), torch.from_numpy(state)).numpy()
        assert seen[:, -WIDTH:] == pytest.approx(state, abs=1e-6)
        before = state.copy()
        seen, _, dones, infos = env.step(actions)
        for row in np.flatnonzero(dones):
            last = infos[row]["terminal_observation"]
            with torch.no_grad():
                end = cell(torch.from_numpy(last[:-WIDTH].copy()), torch.from_numpy(before[row])).numpy()
            assert last[-WIDTH:] == pytest.approx(end, abs=1e-6), "of the episode that ends"
        state[dones | ~trainer.batch.acted] = 0.0
    assert not trainer.batch.acted.all()


def test_an_exported_agent_remembers_as_the_trainer_does(tmp_path: Path) -> None:
    trainer = trainer_of()
    trainer.begin()
    trainer.update()
    shaken(trainer)
    export(tmp_path, tmp_path, trainer, environment_file(FOUR_WAY), [], [])
    agent, driver = load_agent(tmp_path, trainer.scenario), trainer.driver()
    rows = np.random.default_rng(0).uniform(-1, 1, (8, 132)).astype(np.float32)
    first = agent(rows)
    assert first == pytest.approx(driver(rows), abs=1e-5)
    assert agent(rows) == pytest.approx(driver(rows), abs=1e-5)
    assert not np.allclose(agent(rows), first, atol=1e-4), "it has seen them before"
    agent.reset(np.arange(8) < 4)
    again = agent(rows)
    assert again[:4] == pytest.approx(first[:4], abs=1e-6) and not np.allclose(again[4:], first[4:], atol=1e-4)
    tensors = trainer.tensors()
    tensors[f"{MEMORY}bias_ih"] = np.zeros(5)
    trainer.tensors = lambda: tensors
    other = tmp_path / "other"
    other.mkdir()
    export(other, other, trainer, environment_file(FOUR_WAY), [], [])
    with pytest.raises(coopenv.CoopenvError, match=r"weights\.safetensors: shapes do not fit 132 observations"):
        load_agent(other, trainer.scenario)


@pytest.mark.parametrize("updates", [0, 1])
def test_a_checkpoint_goes_on_with_what_is_remembered(updates: int, tmp_path: Path) -> None:
    whole = trainer_of()
    whole.begin()
    for _ in range(updates):
        whole.update()
    save(tmp_path / "checkpoint.safetensors", whole, Course())
    whole.update()
    again = trainer_of()
    restore(read(tmp_path / "checkpoint.safetensors"), again)
    again.update()
    for name, values in whole.tensors().items():
        assert again.tensors()[name] == pytest.approx(values, abs=1e-5), name


def test_a_clone_begins_without_it_and_drives_as_one() -> None:
    trainer = trainer_of(clone=Clone(agent="route_follower", episodes=2, epochs=1))
    trainer.begin()
    rows, driver = np.random.default_rng(0).uniform(-1, 1, (8, 132)).astype(np.float32), trainer.driver()
    assert driver(rows) == pytest.approx(driver(rows), abs=1e-6)
    for _ in range(2):
        trainer.update()
    learnt = trainer.driver()
    assert not np.allclose(learnt(rows), learnt(rows), atol=1e-6), "what is remembered has come to count"


def saved(folder: Path, **settings: object) -> str:
    trainer = trainer_of(**settings)
    trainer.begin()
    trainer.update()
    shaken(trainer)
    folder.mkdir()
    export(folder, folder, trainer, environment_file(FOUR_WAY), [], [])
    return str(folder)


def test_an_agent_without_a_memory_gets_one(tmp_path: Path) -> None:
    plain = PPO.model_copy(update={"memory": None})
    name = saved(tmp_path / "plain", ppo=plain)
    trainer = trainer_of(start=name)
    trainer.begin()
    rows, driver = np.random.default_rng(0).uniform(-1, 1, (8, 132)).astype(np.float32), trainer.driver()
    expected = load_agent(name, trainer.scenario)(rows)
    for _ in range(2):
        assert driver(rows) == pytest.approx(expected, abs=1e-5)
    again = trainer_of(start=saved(tmp_path / "remembering"), ppo=plain)
    with pytest.raises(coopenv.CoopenvError, match=r"ppo\.memory = none: it has a memory"):
        again.begin()


def test_mistakes_are_one_line(tmp_path: Path) -> None:
    (tmp_path / "train.toml").write_text("steps = 0\nppo.memory = 8\n[clone]\nagent = 'peek'\n", encoding="utf-8")
    with pytest.raises(coopenv.CoopenvError, match=r"ppo\.memory: a clone alone has none, set steps"):
        read_settings(tmp_path / "train.toml")
    with pytest.raises(coopenv.CoopenvError, match=r"--onnx: not with ppo\.memory"):
        check_onnx(Settings(ppo=PPO))
