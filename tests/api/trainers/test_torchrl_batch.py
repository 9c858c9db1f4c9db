"""A batch as one batched TorchRL environment. Runs where the extra `torchrl` is installed."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("torchrl", reason="needs the extra 'torchrl'")

import torch
from torchrl.envs.utils import check_env_specs

import coopenv
from coopenv.api.trainers.torchrl import batched_env
from coopenv.api.vector_env import RecordVehicleEpisodes
from tests.helpers.four_way import FOUR_WAY

pytestmark = pytest.mark.torchrl
torch.set_num_threads(1)
OPTIONS = {"num_worlds": 3, "overrides": {"horizon": 6.0}}
STEPS = 150


def test_specs() -> None:
    env = batched_env(FOUR_WAY, **OPTIONS)
    assert env.batch_size == torch.Size([12])
    check_env_specs(env)


def test_episodes_are_those_of_vehicles() -> None:
    """Under wide turns, which end against walls or at the horizon: every end and all rewards are those of the batch."""
    actions = np.column_stack([np.ones(12), np.linspace(0.0, 0.5, 12)]).astype(np.float32)
    env = batched_env(FOUR_WAY, **OPTIONS)
    env.set_seed(0)
    always = torch.from_numpy(actions)
    rollout = env.rollout(STEPS, lambda observation: always.clone(), break_when_any_done=False)
    told = {name: rollout["next", name].squeeze(-1).numpy() for name in ("done", "truncated", "reward")}

    batch = RecordVehicleEpisodes(coopenv.make_vec(FOUR_WAY, autoreset="disabled", **OPTIONS), 1000)
    batch.reset(seed=0)
    batch.reset()  # as `rollout` does
    ends, rewards = np.zeros((12, STEPS), dtype=bool), np.zeros((12, STEPS))
    for step in range(STEPS):
        _, reward, terminated, truncated, infos = batch.step(actions)
        rewards[:, step], ends[:, step] = reward, infos.get("_episode", False)
        over = batch.unwrapped.world_major(terminated | truncated).all(axis=1)
        if over.any():
            batch.reset(options={"reset_mask": over})
    assert np.array_equal(told["done"], ends)
    assert told["reward"] == pytest.approx(rewards, abs=1e-6)
    assert told["truncated"].any() and not told["truncated"].all(where=told["done"])
