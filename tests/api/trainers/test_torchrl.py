"""A batch as one environment of TorchRL: against `parallel_env` and `make_vec`, and PPO on it.

Runs where the extra `torchrl` or `benchmarl` is installed.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

pytest.importorskip("torchrl", reason="needs the extra 'torchrl'")

import torch
import torchrl_ppo
from plain_infos import PlainInfos
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs import EnvBase, GymEnv, PettingZooWrapper
from torchrl.envs.utils import check_env_specs
from torchrl_env import batched_env

import coopenv
from tests.helpers.four_way import FOUR_WAY

pytestmark = pytest.mark.torchrl
torch.set_num_threads(1)

TEAM = {"reward.team": "mean", "horizon": 6.0}
DRIVEN = {"vehicles.vehicle_2.motion.driver": "route_follower", "horizon": 6.0}
STEPS = 150


@pytest.mark.parametrize("name", [FOUR_WAY, "urban_crossing", "take_turns"])
def test_specs(name: str) -> None:
    env = batched_env(name, num_worlds=3, seed=0)
    assert env.batch_size == torch.Size([3])
    check_env_specs(env)


@pytest.mark.parametrize("options", [{}, {"frame_skip": 2}, {"observation": "dict"}], ids=str)
def test_gymnasium_environments_fit(options: dict[str, Any]) -> None:
    """It tries `frameskip` first, and looks for Python's words in the refusal."""
    env = GymEnv("coopenv/OpenSquare-v0", **options)
    check_env_specs(env)
    assert env.rollout(3).batch_size == torch.Size([3])


@pytest.mark.parametrize("options", [{}, {"use_mask": True, "done_on_any": False, "return_state": True}], ids=str)
@pytest.mark.parametrize("name", ["open_square", FOUR_WAY])
def test_the_wrapper_of_pettingzoo_fits(name: str, options: dict[str, Any]) -> None:
    world = coopenv.parallel_env(name, overrides={"horizon": 1.0})
    env = PettingZooWrapper(world, **options)
    check_env_specs(env)
    rollout = env.rollout(25, break_when_any_done=False)
    assert rollout["next", "done"].sum() == 2
    assert rollout["next", "vehicle", "info", "position_error"].shape == (25, len(world.possible_agents))


def turning(worlds: int, vehicles: int) -> np.ndarray:
    """Return wide turns that end against walls or at the horizon, (worlds, vehicles, 2)."""
    steering = np.linspace(0.0, 0.5, worlds * vehicles).reshape(worlds, vehicles)
    return np.stack([np.ones_like(steering), steering], axis=-1).astype(np.float32)


def rolled_out(env: EnvBase, actions: np.ndarray) -> TensorDict:
    """Return a rollout over the ends of worlds, (worlds, steps)."""
    always = torch.from_numpy(actions)
    policy = TensorDictModule(lambda state: always.clone(), ["state"], [("vehicle", "action")])
    return env.rollout(STEPS, policy, break_when_any_done=False)


@pytest.mark.parametrize(
    ("name", "overrides"),
    [
        (FOUR_WAY, {"horizon": 6.0}),
        ("urban_crossing", {"horizon": 7.0}),
        (FOUR_WAY, TEAM),
        (FOUR_WAY, DRIVEN),
        ("behind_truck", {"horizon": 6.0}),
    ],
)
def test_each_world_is_a_parallel_env(name: str, overrides: dict[str, Any]) -> None:
    """Observations, rewards, ends, masks, states and infos of all episodes, the later ones included."""
    env = batched_env(name, num_worlds=3, seed=5, overrides=overrides)
    events = () if "reward.team" in overrides else ("arrived", "collided")  # a team's are those of its world
    agents = env.group_map["vehicle"]
    actions = turning(3, len(agents))
    rollout = rolled_out(env, actions)
    for w in range(3):
        world, got = PlainInfos(coopenv.parallel_env(name, overrides=overrides)), rollout[w]
        assert world.possible_agents == agents
        observations, _ = world.reset(seed=5, options={"world": w})
        for t in range(STEPS):
            now, then = got[t], got[t]["next"]
            acting = [agent in world.agents for agent in agents]
            assert now["vehicle", "mask"].tolist() == acting
            assert np.array_equal(now["state"], world.state())
            observations, rewards, terminated, truncated, infos = world.step(dict(zip(agents, actions[w], strict=True)))
            for i, agent in enumerate(agents):
                row = then["vehicle"][i]
                flags = [bool(row[flag]) for flag in ("terminated", "truncated", "done")]
                if acting[i]:
                    assert np.array_equal(row["observation"], observations[agent])
                    assert row["reward"].item() == rewards[agent]
                    assert flags == [terminated[agent], truncated[agent], agent not in world.agents]
                    for number in ("position_error", "orientation_error", "nees", *events):
                        assert row["info", number].item() == pytest.approx(infos[agent][number], rel=1e-6)
                else:
                    assert flags == [True, False, True]
                    assert not row["observation"].any() and not row["reward"].any()
                assert bool(row["mask"]) == (agent in world.agents)
            assert bool(then["done"]) == (not world.agents) == bool(then["terminated"] | then["truncated"])
            assert bool(then["terminated"]) == bool(then["vehicle", "terminated"].all())
            assert np.array_equal(then["state"], world.state())
            if not world.agents:
                world.reset()
    assert rollout["next", "done"].sum(dim=1).min() >= 2  # so partial resets have happened


def test_a_single_world_is_reset() -> None:
    env = batched_env(FOUR_WAY, num_worlds=3, seed=0)
    data = env.rollout(12)[:, -1]["next"].exclude("reward")
    before = data.clone()
    data["_reset"] = torch.tensor([[False], [True], [False]])
    after = env.reset(data)
    for world in (0, 2):
        assert torch.equal(after[world]["state"], before[world]["state"])
        assert torch.equal(after[world]["vehicle", "observation"], before[world]["vehicle", "observation"])
    assert after[1]["state"][-1] == 0.0 < before[1]["state"][-1]
    assert not torch.equal(after[1]["vehicle", "observation"], before[1]["vehicle", "observation"])
    step = env.rand_step(after)
    shares = step["next", "state"][:, -1]
    assert shares[0] == shares[2] > 12 * shares[1] > 0.0


def test_seeds() -> None:
    first, second, other = (
        batched_env("open_square", num_worlds=2, seed=seed).reset()["vehicle", "observation"] for seed in (7, 7, 8)
    )
    assert torch.equal(first, second) and not torch.equal(first, other) and not torch.equal(first[0], first[1])
    env = batched_env("open_square", num_worlds=2)
    env.reset()
    env.set_seed(7)
    assert torch.equal(env.reset()["vehicle", "observation"], first)
    assert not torch.equal(env.reset()["vehicle", "observation"], first)


def test_pictures() -> None:
    env = batched_env(FOUR_WAY, num_worlds=2, seed=0, render_mode="rgb_array")
    env.reset()
    first = env.render()
    assert first.dtype == np.uint8 and first.ndim == 3
    env.rollout(10)
    assert not np.array_equal(env.render(), first)
    env.close()


def test_the_example_learns() -> None:
    losses, before, after = torchrl_ppo.train(updates=3, steps=100)
    assert losses[7] < losses[0]
    assert any(not torch.equal(a, b) for a, b in zip(before, after, strict=True))
