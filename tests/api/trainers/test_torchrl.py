"""TorchRL's `PettingZooWrapper` rolls out over deaths and trains; a batch is one environment.

Runs where the extra `torchrl` is installed.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

pytest.importorskip("torchrl", reason="needs the extra 'torchrl'")

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from tensordict.nn.distributions import NormalParamExtractor
from torchrl.envs.libs.pettingzoo import PettingZooWrapper
from torchrl.envs.utils import check_env_specs
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

import coopenv
from coopenv.api.parallel_env import PlainInfos
from coopenv.api.trainers.torchrl import batched_env
from coopenv.api.vector_env import RecordVehicleEpisodes
from tests.helpers.four_way import FOUR_WAY

pytestmark = [pytest.mark.torchrl, pytest.mark.filterwarnings("ignore:PettingZoo in TorchRL is tested")]
torch.set_num_threads(1)


def crossing(**overrides: Any) -> PettingZooWrapper:
    world = PlainInfos(coopenv.parallel_env(FOUR_WAY, overrides=overrides))
    return PettingZooWrapper(world, done_on_any=False, use_mask=True, return_state=True)


def test_vehicles_may_be_absent() -> None:
    """In `urban_crossing` they are, in some episodes; their rows are masked."""
    world = PlainInfos(coopenv.parallel_env("urban_crossing"), with_absent=True)
    absent = 0
    for seed in range(4):
        env = PettingZooWrapper(world, done_on_any=False, use_mask=True, return_state=True, seed=seed)
        first = env.reset()["vehicle", "mask"]
        assert first.tolist() == [agent in world.agents for agent in world.possible_agents]
        absent += int((~first).sum())
        assert env.rollout(5).batch_size == (5,)
    assert absent > 0


def actor(env: PettingZooWrapper) -> ProbabilisticActor:
    size = env.observation_spec["vehicle", "observation"].shape[-1]
    network = torch.nn.Sequential(MLP(size, 4, num_cells=[64, 64]), NormalParamExtractor())
    parameters = TensorDictModule(network, [("vehicle", "observation")], [("vehicle", "loc"), ("vehicle", "scale")])
    return ProbabilisticActor(
        parameters,
        spec=env.full_action_spec,
        in_keys=[("vehicle", "loc"), ("vehicle", "scale")],
        out_keys=[("vehicle", "action")],
        distribution_class=TanhNormal,
        distribution_kwargs={"low": -1.0, "high": 1.0},
        return_log_prob=True,
        log_prob_key=("vehicle", "sample_log_prob"),
    )


def test_specs() -> None:
    env, rows = crossing(), batched_env(FOUR_WAY, **OPTIONS)
    assert env.group_map == {"vehicle": [f"vehicle_{i}" for i in range(1, 5)]}
    assert rows.batch_size == torch.Size([12])
    for each in (env, rows):
        check_env_specs(each)


def test_rollout_goes_on_over_deaths() -> None:
    torch.manual_seed(0)
    env = crossing()
    env.set_seed(0)
    rollout = env.rollout(400)
    alive = rollout["vehicle", "mask"]  # (steps, vehicles): acted in this step
    steps = alive.sum(0)
    assert len(steps.unique()) > 1  # vehicles end at times of their own
    assert len(rollout) == steps.max()
    assert rollout["next", "done"].flatten().tolist() == [False] * (len(rollout) - 1) + [True]
    died = rollout["next", "vehicle", "terminated"].squeeze(-1) & alive
    assert (died.sum(0) <= 1).all() and died.any()
    assert not rollout["next", "vehicle", "reward"].squeeze(-1)[~alive].any()
    assert rollout["next", "vehicle", "info", "collided"][died].any()


def test_horizon_truncates() -> None:
    rollout = crossing(horizon=1.0).rollout(50)
    assert len(rollout) == 10
    last = rollout["next"][-1]
    assert last["truncated"].all() and not last["terminated"].any()
    assert last["vehicle", "truncated"].all() and not last["vehicle", "terminated"].any()


def test_ppo_trains_on_living_rows() -> None:
    torch.manual_seed(1)
    env = crossing(horizon=15.0)
    policy = actor(env)
    size = env.observation_spec["vehicle", "observation"].shape[-1]
    critic = TensorDictModule(
        MLP(size, 1, num_cells=[64, 64]), [("vehicle", "observation")], [("vehicle", "state_value")]
    )
    advantage = GAE(gamma=0.99, lmbda=0.95, value_network=critic)
    advantage.set_keys(
        value=("vehicle", "state_value"),
        reward=("vehicle", "reward"),
        done=("vehicle", "done"),
        terminated=("vehicle", "terminated"),
        advantage=("vehicle", "advantage"),
        value_target=("vehicle", "value_target"),
    )
    rows = "vehicle"
    loss = ClipPPOLoss(policy, critic, normalize_advantage=True)
    loss.set_keys(
        action=(rows, "action"),
        sample_log_prob=(rows, "sample_log_prob"),
        value=(rows, "state_value"),
        advantage=(rows, "advantage"),
        value_target=(rows, "value_target"),
    )
    optimiser = torch.optim.Adam(loss.parameters(), 1e-3)
    before = [parameter.detach().clone() for parameter in policy.parameters()]
    errors = []
    for _ in range(3):
        with torch.no_grad():
            rollout = advantage(env.rollout(150, policy))
        vehicles = rollout["vehicle"].exclude("info")
        living = TensorDict({"vehicle": vehicles[vehicles["mask"]]}, batch_size=[int(vehicles["mask"].sum())])
        assert len(living) < vehicles["mask"].numel()
        for _ in range(8):
            losses = loss(living)
            total = losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"]
            assert torch.isfinite(total)
            optimiser.zero_grad()
            total.backward()
            optimiser.step()
            errors.append(losses["loss_critic"].item())
    assert errors[7] < errors[0]
    assert any(not torch.equal(a, b) for a, b in zip(before, policy.parameters(), strict=True))


OPTIONS = {"num_worlds": 3, "overrides": {"horizon": 6.0}}
STEPS = 150


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
