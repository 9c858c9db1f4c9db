"""The batch as RLlib's environment, on a cluster of two nodes on this machine. Needs the extra `rllib`."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

pytest.importorskip("ray.rllib", reason="needs the extra 'rllib'")

import ray
import torch
from ray.cluster_utils import Cluster
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.env.single_agent_env_runner import SingleAgentEnvRunner
from rllib_env import CooperativeRows

import coopenv
from tests.helpers.four_way import FOUR_WAY

pytestmark = pytest.mark.rllib
torch.set_num_threads(1)
SHORT = {"horizon": 6.0}
ROWS = 16


@pytest.fixture(scope="module", autouse=True)
def two_nodes() -> Iterator[None]:
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    cluster.add_node(num_cpus=1)
    ray.init(address=cluster.address, log_to_driver=False)
    yield
    ray.shutdown()
    cluster.shutdown()


def ppo(runners: int, rows: int = ROWS, **env_config: Any) -> PPOConfig:
    return (
        PPOConfig()
        .environment(CooperativeRows, env_config={"env": FOUR_WAY, "overrides": SHORT, **env_config})
        .env_runners(
            num_env_runners=runners,
            num_envs_per_env_runner=rows,
            num_cpus_per_env_runner=1,
            gym_env_vectorize_mode="vector_entry_point",
        )
        .learners(num_learners=0)
        .training(train_batch_size_per_learner=2000, minibatch_size=500, num_epochs=2)
        .debugging(seed=0)
    )


def test_episodes_are_those_of_vehicles() -> None:
    """Nobody's time parked is one: it would end with return 0."""
    runner = SingleAgentEnvRunner(config=ppo(runners=0))
    episodes = [episode for episode in runner.sample(num_timesteps=ROWS * 130) if episode.is_done]
    assert len(episodes) >= ROWS
    assert {episode.is_terminated for episode in episodes} == {True, False}
    assert {len(episode) for episode in episodes[:ROWS] if episode.is_truncated} == {60}  # the horizon is not a death
    assert all(episode.get_return() != 0.0 for episode in episodes)


def test_other_vectorisation_is_refused() -> None:
    with pytest.raises(coopenv.CoopenvError, match="gym_env_vectorize_mode='vector_entry_point'"):
        CooperativeRows({"env": FOUR_WAY})
