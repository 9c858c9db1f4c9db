"""BenchMARL really trains on the task. Runs where the extra `benchmarl` is installed."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("benchmarl", reason="needs the extra 'benchmarl'")

import torch
from benchmarl.algorithms import IppoConfig, MappoConfig
from benchmarl.experiment import Experiment, ExperimentConfig
from benchmarl.models.mlp import MlpConfig

from coopenv.api.trainers.benchmarl import task
from tests.helpers.four_way import FOUR_WAY

pytestmark = [pytest.mark.benchmarl, pytest.mark.filterwarnings("ignore")]
torch.set_num_threads(1)


def configuration(folder: Path) -> ExperimentConfig:
    """Return two short iterations in this process that write nothing but into `folder`."""
    config = ExperimentConfig.get_from_yaml()
    config.max_n_iters, config.max_n_frames = 2, None
    config.on_policy_collected_frames_per_batch = 400
    config.on_policy_n_envs_per_worker = 2
    config.on_policy_n_minibatch_iters = 2
    config.on_policy_minibatch_size = 100
    config.evaluation_interval, config.evaluation_episodes = 400, 1
    config.loggers, config.create_json, config.render = [], False, False
    config.save_folder = str(folder)
    return config


@pytest.mark.parametrize("algorithm", [MappoConfig, IppoConfig])
def test_trains(algorithm: type[MappoConfig], tmp_path: Path) -> None:
    model = MlpConfig(num_cells=[64, 64], activation_class=torch.nn.Tanh, layer_class=torch.nn.Linear)
    experiment = Experiment(
        task=task(FOUR_WAY, overrides={"horizon": 10.0}),
        algorithm_config=algorithm.get_from_yaml(),
        model_config=model,
        critic_model_config=model,
        seed=0,
        config=configuration(tmp_path),
    )
    before = [parameter.detach().clone() for parameter in experiment.policy.parameters()]
    experiment.run()
    assert experiment.total_frames == 800
    after = list(experiment.policy.parameters())
    assert all(torch.isfinite(parameter).all() for parameter in after)
    assert any(not torch.equal(a, b) for a, b in zip(before, after, strict=True))


def test_specs() -> None:
    crossing = task(FOUR_WAY)
    env = crossing.get_env_fun(num_envs=1, continuous_actions=True, seed=0, device="cpu")()
    assert crossing.group_map(env) == {"vehicle": [f"vehicle_{i}" for i in range(1, 5)]}
    assert crossing.max_steps(env) == 400
    assert crossing.observation_spec(env)["vehicle", "observation"].shape == (4, 132)
    assert list(crossing.observation_spec(env)["vehicle"].keys()) == ["observation"]
    assert crossing.state_spec(env)["state"].shape == env.unwrapped.state_space.shape
    assert crossing.action_spec(env)["vehicle", "action"].shape == (4, 2)


def test_every_world_has_a_seed_of_its_own() -> None:
    make = task(FOUR_WAY).get_env_fun(num_envs=2, continuous_actions=True, seed=7, device="cpu")
    first, second = (make().reset()["vehicle", "observation"] for _ in range(2))
    assert not torch.equal(first, second)
    again = task(FOUR_WAY).get_env_fun(num_envs=2, continuous_actions=True, seed=7, device="cpu")
    assert torch.equal(first, again().reset()["vehicle", "observation"])
