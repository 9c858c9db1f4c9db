"""BenchMARL really trains on the batched task. Runs where the extra `benchmarl` is installed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("benchmarl", reason="needs the extra 'benchmarl'")

import torch
from benchmarl.algorithms import IppoConfig, MaddpgConfig, MappoConfig
from benchmarl.experiment import Callback, Experiment, ExperimentConfig
from benchmarl.models import GruConfig
from benchmarl.models.mlp import MlpConfig
from benchmarl_task import task

from tests.helpers.four_way import FOUR_WAY

pytestmark = [pytest.mark.benchmarl, pytest.mark.filterwarnings("ignore")]
torch.set_num_threads(1)

LAYERS = {"activation_class": torch.nn.Tanh, "layer_class": torch.nn.Linear}
MLP = MlpConfig(num_cells=[64, 64], **LAYERS)
GRU = GruConfig.get_from_yaml()


class Samples(Callback):
    """Keeps what BenchMARL hands to callbacks."""

    def __init__(self) -> None:
        super().__init__()
        self.batches: list[Any] = []
        self.samples: list[Any] = []
        self.rollouts: list[Any] = []

    def on_batch_collected(self, batch: Any) -> None:
        self.batches.append(batch)

    def on_train_step(self, batch: Any, group: str) -> None:
        self.samples.append(batch.clone())

    def on_evaluation_end(self, rollouts: Any) -> None:
        self.rollouts.append(rollouts)


def experiment(
    folder: Path, algorithm: Any, model: Any = MLP, horizon: float = 10.0, **options: Any
) -> tuple[Experiment, Samples]:
    """Return one of two short iterations, ten worlds at once, that writes into `folder` alone; and what it hands on."""
    config, samples = ExperimentConfig.get_from_yaml(), Samples()
    config.max_n_iters, config.max_n_frames = 2, None
    for policy in ("on", "off"):
        setattr(config, f"{policy}_policy_collected_frames_per_batch", 800)
        setattr(config, f"{policy}_policy_n_envs_per_worker", 10)
    config.on_policy_n_minibatch_iters, config.on_policy_minibatch_size = 2, 200
    config.off_policy_n_optimizer_steps = 2
    config.evaluation_interval, config.evaluation_episodes = 800, 3
    config.loggers, config.create_json, config.render = [], True, True
    config.save_folder = str(folder)
    crossing = task(FOUR_WAY, overrides={"horizon": horizon}, **options)
    algorithm = algorithm.get_from_yaml()
    return Experiment(crossing, algorithm, model, 0, config, critic_model_config=model, callbacks=[samples]), samples


@pytest.mark.parametrize(
    ("algorithm", "model"), [(MappoConfig, MLP), (IppoConfig, MLP), (MappoConfig, GRU), (MaddpgConfig, MLP)]
)
def test_trains(algorithm: Any, model: Any, tmp_path: Path) -> None:
    trained, samples = experiment(tmp_path, algorithm, model)
    before = [parameter.detach().clone() for parameter in trained.policy.parameters()]
    trained.run()
    assert trained.total_frames == 1600
    after = list(trained.policy.parameters())
    assert all(torch.isfinite(parameter).all() for parameter in after)
    assert any(not torch.equal(a, b) for a, b in zip(before, after, strict=True))
    assert [len(rollouts) for rollouts in samples.rollouts] == [3, 3]


def test_rows_that_did_not_act_are_not_learned_from(tmp_path: Path) -> None:
    trained, samples = experiment(tmp_path, MappoConfig)
    trained.run()
    rows = torch.cat(
        [sample["vehicle"].select("mask", "advantage", "value_target", "state_value") for sample in samples.samples]
    )
    acted = rows["mask"]
    assert 0.02 < (~acted).float().mean() < 0.9
    assert not rows["advantage"][~acted].any()
    assert torch.equal(rows["value_target"][~acted], rows["state_value"][~acted])
    assert (rows["advantage"][acted] != 0).float().mean() > 0.99
    assert not torch.allclose(rows["value_target"][acted], rows["state_value"][acted], atol=1e-3)


def test_specs() -> None:
    crossing = task(FOUR_WAY)
    env = crossing.get_env_fun(num_envs=5, continuous_actions=True, seed=0, device="cpu")()
    assert env.batch_size == torch.Size([5])
    assert crossing.group_map(env) == {"vehicle": [f"vehicle_{i}" for i in range(1, 5)]}
    assert crossing.max_steps(env) == 400
    assert crossing.observation_spec(env)["vehicle", "observation"].shape == (4, 132)
    assert list(crossing.observation_spec(env)["vehicle"].keys()) == ["observation"]
    assert crossing.state_spec(env)["state"].shape == env.batch.state()[0].shape
    assert crossing.action_spec(env)["vehicle", "action"].shape == (4, 2)
    assert not crossing.has_render(env)
