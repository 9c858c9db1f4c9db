"""`examples/train_ppo.py` trains, leaves out the rows that did not act, and bootstraps where it should."""

from __future__ import annotations

import csv
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the extra 'train'")
pytest.importorskip("tyro", reason="needs the extra 'train'")
pytest.importorskip("tensorboard", reason="needs the extra 'train'")

import torch
from safetensors.torch import load_file

import coopenv
from tests.helpers import four_way
from tests.helpers.four_way import FOUR_WAY

pytestmark = pytest.mark.train
torch.set_num_threads(1)


@pytest.fixture(scope="module")
def ppo() -> ModuleType:
    return four_way.example("train_ppo")


FEW = f"--env {FOUR_WAY} --num-worlds 4 --rollout 16 --total-steps 1024 --minibatches 2 --epochs 2"


def few(ppo: ModuleType, folder: Path, *more: str) -> Any:
    words = [*FEW.split(), "--log-every", "1", "--evaluation-worlds", "2", "--out", str(folder), *more]
    return ppo.tyro.cli(ppo.Arguments, args=words)


def test_trains_and_saves(ppo: ModuleType, tmp_path: Path) -> None:
    args = few(ppo, tmp_path)
    curve = ppo.train(args)
    assert [row["vehicle_steps"] for row in curve] == [256, 512, 768, 1024]
    assert all(np.isfinite(value) for row in curve for value in row.values())
    with (tmp_path / "curve.csv").open(encoding="utf-8") as file:
        assert len(list(csv.DictReader(file))) == 4
    assert list((tmp_path / "tensorboard").glob("events.*"))
    saved = load_file(tmp_path / "weights.safetensors")
    policy = ppo.Policy(132, 2, args.hidden, args.initial_std)
    untrained = {name: values.clone() for name, values in policy.state_dict().items()}
    policy.load_state_dict(saved)
    assert not torch.equal(saved["log_std"], untrained["log_std"])
    assert saved["normaliser.count"] > 0


def test_resumes_from_its_checkpoint(ppo: ModuleType, tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match=r"nothing to resume: there is no .*checkpoint\.pt"):
        ppo.train(few(ppo, tmp_path, "--resume"))
    args = few(ppo, tmp_path)
    with pytest.MonkeyPatch.context() as patched:  # ended by force after the second checkpoint
        save = ppo.Store.save

        def save_twice(store: Any, done: int, *rest: Any) -> None:
            save(store, done, *rest)
            if done == 2:
                raise KeyboardInterrupt

        patched.setattr(ppo.Store, "save", save_twice)
        with pytest.raises(KeyboardInterrupt):
            ppo.train(args)
    before = torch.load(tmp_path / "checkpoint.pt", weights_only=True)
    assert before["done"] == 2
    curve = ppo.train(few(ppo, tmp_path, "--resume"))
    assert [row["vehicle_steps"] for row in curve] == [256, 512, 768, 1024]
    assert curve[:2] == before["curve"]
    after = torch.load(tmp_path / "checkpoint.pt", weights_only=True)
    assert after["policy"]["normaliser.count"] > before["policy"]["normaliser.count"]
    assert after["optimiser"]["state"][0]["step"] == 2 * before["optimiser"]["state"][0]["step"]


def test_is_reproducible(ppo: ModuleType) -> None:
    args = ppo.Arguments(num_worlds=2, rollout=8, total_steps=128, minibatches=2, evaluation_worlds=1, log_every=1)
    first, second = (
        [{name: value for name, value in row.items() if name != "seconds"} for row in ppo.train(args)] for _ in range(2)
    )
    assert first == second


def rollout(ppo: ModuleType, env: coopenv.CooperativeVectorEnv, steps: int, bias: list[float]) -> dict[str, object]:
    """Return a rollout under an action that is always the same."""
    args = ppo.Arguments(rollout=steps)
    policy = ppo.Policy(env.single_observation_space.shape[0], 2, hidden=8, initial_std=1e-6)
    with torch.no_grad():
        policy.actor[-1].bias.copy_(torch.tensor(bias))
        policy.actor[-1].weight.zero_()
        first, _ = env.reset(seed=0)
        now = {"observation": first, "done": torch.zeros(env.num_envs, dtype=torch.bool)}
        buffer, _ = ppo.collect(args, env, policy, now, ppo.Tally(env.num_envs, "cpu", env.engine.reward_terms))
    return buffer


def test_reset_steps_are_left_out(ppo: ModuleType) -> None:
    env = coopenv.make_vec(FOUR_WAY, num_worlds=2, overrides={"horizon": 1.0}, arrays="torch")
    buffer = rollout(ppo, env, 33, [-1.0, 0.0])
    acted = torch.tensor([True] * 10 + [False]).repeat(3)
    assert torch.equal(buffer["valid"], acted[:, None].expand(-1, env.num_envs))
    assert torch.equal(buffer["truncated"].any(1), torch.tensor([False] * 9 + [True, False]).repeat(3))
    # the last observation of an episode stands where the reset step starts, and not the next episode's first
    assert not torch.equal(buffer["observation"][10], buffer["observation"][11])


def test_parked_vehicles_are_left_out(ppo: ModuleType) -> None:
    env = coopenv.make_vec(FOUR_WAY, num_worlds=2, overrides={"horizon": 20.0}, arrays="torch")
    steps = 201
    buffer = rollout(ppo, env, steps, [1.0, 0.4])  # a wide turn into a wall
    parked = torch.zeros(env.num_envs, dtype=torch.bool)
    world_over = torch.zeros(env.num_envs, dtype=torch.bool)
    for t in range(steps):
        assert torch.equal(buffer["valid"][t], ~parked & ~world_over)
        assert not buffer["reward"][t, parked].any()
        done = buffer["terminated"][t] | buffer["truncated"][t]
        parked |= buffer["terminated"][t]
        world_over = (done | parked).reshape(2, 4).all(1).repeat_interleave(4)
        parked &= ~world_over
    assert buffer["terminated"].any() and not buffer["valid"].all()


def test_advantages_against_a_discounted_sum(ppo: ModuleType) -> None:
    """With lambda = 1 the return is the discounted sum, plus the value at the cut; three rows: cut, dead, going on."""
    args = ppo.Arguments(rollout=3, gamma=0.5, gae_lambda=1.0)
    off = torch.zeros(3, 3, dtype=torch.bool)
    terminated, truncated = off.clone(), off.clone()
    truncated[1, 0] = True
    terminated[1, 1] = True
    value = torch.tensor([[1.0, 1.0, 1.0], [2.0, 2.0, 2.0], [8.0, 8.0, 8.0]])
    buffer = {"reward": torch.ones(3, 3), "value": value, "terminated": terminated, "truncated": truncated}
    result = ppo.advantages(args, buffer, torch.full((3,), 16.0)) + value
    assert result[0].tolist() == [1 + 0.5 + 0.25 * 8, 1 + 0.5, 1 + 0.5 + 0.25 + 0.125 * 16]
    assert result[1].tolist() == [1 + 0.5 * 8, 1.0, 1 + 0.5 + 0.25 * 16]
