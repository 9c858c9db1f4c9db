"""RLlib's new API stack really trains on a world. Runs where the extra `rllib` is installed."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

pytest.importorskip("ray.rllib", reason="needs the extra 'rllib'")

import ray
import torch
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.env.multi_agent_env_runner import MultiAgentEnvRunner
from rllib_env import CooperativeMultiAgentEnv

from tests.helpers.four_way import FOUR_WAY

pytestmark = pytest.mark.rllib
torch.set_num_threads(1)


@pytest.fixture(autouse=True, scope="module")
def _ray() -> Iterator[None]:
    ray.init(num_cpus=1, include_dashboard=False, log_to_driver=False, ignore_reinit_error=True)
    yield
    ray.shutdown()


def shared_policy(**env_config: Any) -> PPOConfig:
    """Return PPO with one policy for all vehicles, in this process."""
    return (
        PPOConfig()
        .environment(CooperativeMultiAgentEnv, env_config={"env": FOUR_WAY, **env_config})
        .env_runners(num_env_runners=0, num_envs_per_env_runner=2)
        .learners(num_learners=0)
        .multi_agent(policies={"shared"}, policy_mapping_fn=lambda agent, episode, **_: "shared")
        .training(train_batch_size_per_learner=600, minibatch_size=200, num_epochs=2)
        .debugging(seed=0)
    )


def test_ppo_trains_a_shared_policy() -> None:
    algorithm = shared_policy(overrides={"horizon": 8.0}).build_algo()
    before = {name: values.copy() for name, values in algorithm.get_module("shared").get_state().items()}
    for _ in range(3):
        result = algorithm.train()
    after = algorithm.get_module("shared").get_state()
    assert any(not np.array_equal(before[name], after[name]) for name in before)
    assert np.isfinite(result["learners"]["shared"]["total_loss"])
    assert np.isfinite(result["env_runners"]["episode_return_mean"])
    # vehicles die on their own: fewer decisions of vehicles than decisions of worlds times four
    agent_steps = sum(result["env_runners"]["num_agent_steps_sampled"].values())
    assert 0 < agent_steps < 4 * result["env_runners"]["num_env_steps_sampled"]
    algorithm.stop()


def test_time_limit_is_a_truncation() -> None:
    """At the horizon nobody has terminated, so the value beyond it counts."""
    runner = MultiAgentEnvRunner(config=shared_policy(overrides={"horizon": 1.0}))
    episodes = [episode for episode in runner.sample(num_timesteps=60) if episode.is_done]
    assert episodes
    for episode in episodes:
        assert episode.is_truncated and not episode.is_terminated
        for vehicle in episode.agent_episodes.values():
            assert (len(vehicle), vehicle.is_truncated, vehicle.is_terminated) == (10, True, False)


def into_the_wall(env: CooperativeMultiAgentEnv) -> dict[str, np.ndarray]:
    """Return full speed in a wide turn for every vehicle under way, each one's a little wider."""
    turns = {agent: 0.2 + 0.1 * i for i, agent in enumerate(env.possible_agents)}
    return {agent: np.array([1.0, turns[agent]], dtype=np.float32) for agent in env.agents}


def drive(env: CooperativeMultiAgentEnv) -> tuple[dict[str, int], int, dict[str, bool], dict[str, bool]]:
    """Return the step in which each vehicle terminated, the number of steps, and the last flags."""
    env.reset(seed=0)
    ended: dict[str, int] = {}
    for step in range(1, 401):
        actions = into_the_wall(env)
        observations, rewards, terminated, truncated, infos = env.step(actions)
        assert set(observations) == set(rewards) == set(actions) == set(infos)
        ended.update({agent: step for agent in actions if terminated[agent]})
        if terminated["__all__"] or truncated["__all__"]:
            break
    return ended, step, terminated, truncated


def test_a_death_ends_a_single_vehicle_in_the_step_of_the_horizon_too() -> None:
    """Only the vehicle that ended by itself is flagged as terminated; the others are cut off at the horizon."""
    ended, steps, terminated, truncated = drive(CooperativeMultiAgentEnv({"env": FOUR_WAY}))
    assert len(ended) == 4 and len(set(ended.values())) > 1
    assert steps == max(ended.values())
    assert terminated["__all__"] and not truncated["__all__"]
    first, step = min(ended.items(), key=lambda item: item[1])
    config = {"env": FOUR_WAY, "overrides": {"horizon": step / 10}}
    _, steps, terminated, truncated = drive(CooperativeMultiAgentEnv(config))
    assert steps == step
    assert terminated[first] and sum(terminated.values()) == 1
    assert truncated == {"__all__": True}
