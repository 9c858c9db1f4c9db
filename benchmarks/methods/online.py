"""Methods that learn while they drive: of BenchMARL, of `coopenv train`, and sb3-contrib's recurrent PPO."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Generator
from contextlib import closing
from typing import Any, Literal

import numpy as np
import torch
from benchmarl.algorithms import IppoConfig, MappoConfig
from benchmarl.experiment import Experiment, ExperimentConfig
from benchmarl.models import GnnConfig, SequenceModelConfig
from benchmarl.models.mlp import MlpConfig
from benchmarl_task import task
from sb3_contrib import RecurrentPPO
from sb3_contrib.common.recurrent.buffers import RecurrentRolloutBuffer
from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy
from sb3_contrib.common.recurrent.type_aliases import RecurrentRolloutBufferSamples
from tensordict import TensorDict
from torch_geometric.nn.conv import GraphConv
from torchrl.envs import ExplorationType, set_exploration_type
from torchrl_env import GROUP

from coopenv.api.engine import Engine
from coopenv.api.trainers.sb3 import CooperativeSB3VecEnv
from coopenv.base.sections import Section
from coopenv.policies import Policy
from coopenv.training.command import possible
from coopenv.training.settings import Ppo, Settings, TrainingPlan
from coopenv.training.trainer import Trainer

Driver = Callable[[Engine], Policy]
"""Makes the learned policy for the worlds of an engine."""
ALGORITHMS = {"ippo": IppoConfig, "mappo": MappoConfig}
LAYERS = {"activation_class": torch.nn.Tanh, "layer_class": torch.nn.Linear}


class BenchMarl(Section):
    """PPO of BenchMARL with shared parameters."""

    algorithm: Literal["ippo", "mappo"]
    """`mappo`: the critic gets `state()`; `ippo`: what the vehicle observes."""
    communicates: bool = False
    """Whether a graph layer of the actor adds the mean of what the other vehicles send: learned vectors of `hidden`."""
    hidden: int = 128
    """Units of each of two hidden layers (tanh)."""
    worlds: int = 64
    decisions: int = 25
    """Steps of every world between two updates."""
    minibatch: int = 400
    """World steps."""
    epochs: int = 4
    learning_rate: float = 5e-4
    gae_lambda: float = 0.95
    """Of the generalised advantage estimate; that of `coopenv train`."""
    initial_std: float = 0.3
    """Of the exploration, before tanh."""


class GroupDriver:
    """Drives by the mean action of a TorchRL policy for all vehicles of a world at once."""

    def __init__(self, policy: Any, engine: Engine) -> None:
        self.policy, self.engine = policy, engine

    def __call__(self, observations: np.ndarray) -> np.ndarray:
        """Return actions, (rows, A), rows (world, vehicle).

        Where an episode is over the observation is 0, as in training; with a reward of the team, it is over for all
        vehicles at once.
        """
        going = self.engine.view("ended") == 0
        if self.engine.backend.scenario.reward.team != "own":
            going = np.broadcast_to(going.any(axis=1, keepdims=True), going.shape)
        rows = torch.from_numpy(observations.reshape(*going.shape, -1) * going[..., None])
        group = TensorDict({GROUP: TensorDict({"observation": rows.float()}, going.shape)}, going.shape[:1])
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            actions = self.policy(group)[GROUP, "action"]
        return np.asarray(actions.reshape(len(observations), -1))


def benchmarl(environment: str, decisions: int, seed: int, options: dict[str, Any]) -> Driver:
    """Train by BenchMARL for so many decisions of vehicles, those of parked vehicles counted in."""
    asked, config = BenchMarl(**options), ExperimentConfig.get_from_yaml()
    place = task(environment)
    env = place.get_env_fun(1, True, 0, "cpu")()
    vehicles = len(env.group_map[GROUP])
    env.close()
    steps = asked.worlds * asked.decisions
    config.max_n_iters, config.max_n_frames = max(1, round(decisions / vehicles / steps)), None
    config.loggers, config.create_json, config.evaluation, config.render = [], False, False, False
    config.evaluation_episodes = 1
    config.on_policy_n_envs_per_worker, config.on_policy_collected_frames_per_batch = asked.worlds, steps
    config.on_policy_minibatch_size, config.on_policy_n_minibatch_iters = min(asked.minibatch, steps), asked.epochs
    config.lr = asked.learning_rate
    algorithm = ALGORITHMS[asked.algorithm].get_from_yaml()
    algorithm.share_param_critic = asked.algorithm == "ippo"  # else one value for all vehicles, whose rewards differ
    algorithm.lmbda = asked.gae_lambda
    algorithm.scale_mapping = f"biased_softplus_{asked.initial_std}"
    critic = actor = MlpConfig(num_cells=[asked.hidden] * 2, **LAYERS)
    if asked.communicates:
        ends = [MlpConfig(num_cells=[asked.hidden], **LAYERS) for _ in range(2)]
        graph = GnnConfig(topology="full", self_loops=False, gnn_class=GraphConv, gnn_kwargs={"aggr": "mean"})
        actor = SequenceModelConfig([ends[0], graph, ends[1]], intermediate_sizes=[asked.hidden] * 2)
    with tempfile.TemporaryDirectory() as folder:
        config.save_folder = folder
        experiment = Experiment(place, algorithm, actor, seed, config, critic_model_config=critic)
        experiment.run()
    return lambda engine: GroupDriver(experiment.policy, engine)


class ActingSequences(RecurrentRolloutBuffer):
    """Sequences in whose losses only the decisions of vehicles under way count."""

    def __init__(self, *arguments: Any, rows: CooperativeSB3VecEnv, **options: Any) -> None:
        self._rows = rows
        super().__init__(*arguments, **options)

    def reset(self) -> None:
        """Remove the collected steps."""
        self._acted = np.zeros((self.buffer_size, self.n_envs, 1), dtype=np.float32)
        super().reset()

    def add(self, *step: Any, **named: Any) -> None:
        """Add a step, and which vehicles were under way in it."""
        self._acted[self.pos, :, 0] = self._rows.acted
        super().add(*step, **named)

    def get(self, batch_size: int | None = None) -> Generator[RecurrentRolloutBufferSamples, None, None]:
        """Yield minibatches of sequences."""
        self._flat = self.swap_and_flatten(self._acted)[:, 0]
        yield from super().get(batch_size)

    def _get_samples(self, batch_inds: np.ndarray, *others: Any) -> RecurrentRolloutBufferSamples:
        found = super()._get_samples(batch_inds, *others)
        return found._replace(mask=self.pad_and_flatten(self._flat[batch_inds]))


class ActingRecurrentPpo(RecurrentPPO):
    """Recurrent PPO that takes what `Trainer` gives an algorithm."""

    rollout_buffer: Any

    def __init__(self, *arguments: Any, rollout_buffer_class: Any, rollout_buffer_kwargs: Any, **options: Any) -> None:
        self._rows = rollout_buffer_kwargs["rows"]
        super().__init__(*arguments, **options)

    def _setup_model(self) -> None:
        super()._setup_model()
        buffer, spaces = self.rollout_buffer, (self.observation_space, self.action_space)
        factors = {"gamma": self.gamma, "gae_lambda": self.gae_lambda, "n_envs": self.n_envs, "rows": self._rows}
        self.rollout_buffer = ActingSequences(self.n_steps, *spaces, buffer.hidden_state_shape, self.device, **factors)


class Lstm(RecurrentActorCriticPolicy):
    """A long short-term memory of 64 units before each of the networks of policy and value."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, lstm_hidden_size=64, **options)


class RecurrentTrainer(Trainer):
    """The training of `coopenv train` with a memory."""

    kinds = (ActingRecurrentPpo, Lstm, ActingSequences)


class Remembering:
    """Drives by a recurrent policy."""

    def __init__(self, trainer: Trainer) -> None:
        self.trainer, self.state, self.fresh = trainer, None, np.ones(0, dtype=bool)

    def reset(self, mask: np.ndarray) -> None:
        """Forget the rows where an episode begins."""
        self.fresh = mask.copy()

    def __call__(self, observations: np.ndarray) -> np.ndarray:
        """Return actions, (rows, A)."""
        seen, model = self.trainer.env.normalise(observations), self.trainer.model
        actions, self.state = model.predict(seen, self.state, self.fresh, deterministic=True)
        self.fresh = np.zeros(len(observations), dtype=bool)
        return np.asarray(actions)


class Sb3(Section):
    """PPO of `coopenv train`, or sb3-contrib's with a memory in the same training."""

    recurrent: bool = False
    ppo: Ppo = Ppo()
    """As in its settings."""


def coopenv_train(environment: str, decisions: int, seed: int, options: dict[str, Any]) -> Driver:
    """Train by `coopenv train` for so many decisions of vehicles, those of parked vehicles counted in."""
    asked = Sb3(**options)
    plan = TrainingPlan(environment, Settings(steps=decisions, ppo=asked.ppo), seed)
    kind = RecurrentTrainer if asked.recurrent else Trainer
    with closing(kind(plan, possible(plan), threads=1)) as trainer:
        trainer.begin()
        while trainer.status.share < 1.0:
            trainer.update()
    return lambda engine: Remembering(trainer) if asked.recurrent else trainer.driver()
