"""`python -m benchmarks.mappo [ENV]`: world steps per CPU second of MAPPO in BenchMARL, batched and one at a time.

The whole loop of BenchMARL's experiment on one thread: collection with the policy, advantages of the central critic,
updates of both. "One at a time" is the way of environments without a batch: ten worlds in turn through TorchRL's
`PettingZooWrapper`, minibatches of 400 world steps, which is BenchMARL's default. Both take turns. The first iteration
of an experiment is left out. Needs the extra `benchmarl`.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from itertools import count
from typing import Any

import numpy as np
import torch
from benchmarl.algorithms import MappoConfig
from benchmarl.experiment import Callback, Experiment, ExperimentConfig
from benchmarl.models.mlp import MlpConfig
from benchmarl_task import CooperativeTask
from plain_infos import PlainInfos
from rich.console import Console
from torchrl.envs import EnvBase
from torchrl.envs.libs.pettingzoo import PettingZooWrapper

from benchmarks.machine import machine
from benchmarks.training import mean_and_error
from coopenv.api.make import parallel_env
from coopenv.report.table import Table

ITERATIONS = 6
"""Of an experiment, beside the first."""


class Clock(Callback):
    """CPU seconds of the parts of each iteration: stepping worlds, the rest of the collection, updates."""

    def __init__(self) -> None:
        super().__init__()
        self.rows: list[tuple[float, float, float]] = []
        self.worlds = self.start = self.collected = 0.0

    def timed(self, step: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function whose time counts as that of the worlds."""

        def function(*arguments: Any, **options: Any) -> Any:
            start = time.process_time()
            result = step(*arguments, **options)
            self.worlds += time.process_time() - start
            return result

        return function

    def on_batch_collected(self, batch: Any) -> None:
        """Note when the updates begin."""
        self.collected = time.process_time()

    def on_train_end(self, training_td: Any, group: str) -> None:
        """Keep the times of the iteration."""
        now, collection = time.process_time(), self.collected - self.start
        self.rows.append((self.worlds, collection - self.worlds, now - self.collected))
        self.start, self.worlds = now, 0.0


class Batched(CooperativeTask):
    """The task with a clock."""

    clock: Clock

    def get_env_fun(self, *options: Any, **named: Any) -> Callable[[], EnvBase]:
        """Return a maker of a batch."""
        make = super().get_env_fun(*options, **named)

        def function() -> EnvBase:
            env = make()
            env.batch.step, env.batch.reset = (self.clock.timed(each) for each in (env.batch.step, env.batch.reset))
            return env

        return function


class OneAtATime(Batched):
    """The same through PettingZoo."""

    def get_env_fun(self, *_: Any, **__: Any) -> Callable[[], EnvBase]:
        """Return a maker of single worlds, each with the next seed."""
        seeds = count()

        def function() -> EnvBase:
            env: Any = PlainInfos(parallel_env(self.config["name_or_path"]))
            env.step, env.reset = (self.clock.timed(each) for each in (env.step, env.reset))
            seed = next(seeds)
            return PettingZooWrapper(env, done_on_any=False, use_mask=True, return_state=True, seed=seed)

        return function

    def max_steps(self, env: EnvBase) -> int:
        """Return any number: nothing is evaluated."""
        return 1

    def has_render(self, env: EnvBase) -> bool:
        """Return False: nothing is evaluated."""
        return False


KINDS: tuple[tuple[type[Batched], int, int, int], ...] = ((Batched, 256, 25, 1280), (OneAtATime, 10, 120, 400))
"""Class, worlds, steps of each between updates, and world steps of a minibatch."""


def costs(
    kind: type[Batched], worlds: int, steps: int, minibatch: int, asked: argparse.Namespace, seed: int
) -> np.ndarray:
    """Return CPU seconds per world step of the three parts, in the mean of an experiment's iterations, (3,)."""
    task = kind(asked.environment, {"name_or_path": asked.environment})
    task.clock = clock = Clock()
    config = ExperimentConfig.get_from_yaml()
    config.max_n_iters, config.max_n_frames = ITERATIONS + 1, None
    config.loggers, config.create_json, config.evaluation = [], False, False
    config.on_policy_n_envs_per_worker, config.on_policy_collected_frames_per_batch = worlds, worlds * steps
    config.on_policy_minibatch_size, config.on_policy_n_minibatch_iters = minibatch, asked.epochs
    model = MlpConfig(num_cells=asked.hidden, activation_class=torch.nn.Tanh, layer_class=torch.nn.Linear)
    with tempfile.TemporaryDirectory() as folder:
        config.save_folder = folder
        mappo = MappoConfig.get_from_yaml()
        Experiment(task, mappo, model, seed, config, critic_model_config=model, callbacks=[clock]).run()
    return np.asarray(np.mean(clock.rows[1:], axis=0) / (worlds * steps))


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.mappo", description=__doc__)
    parser.add_argument("environment", nargs="?", default="open_square", metavar="ENV")
    parser.add_argument("--rounds", type=int, default=5, choices=range(2, 1000), metavar="N", help="default: 5")
    parser.add_argument("--epochs", type=int, default=4, metavar="N", help="of an update (default: 4)")
    parser.add_argument("--hidden", type=int, nargs="+", default=[128, 128], metavar="N", help="default: 128 128")
    asked = parser.parse_args(arguments)
    torch.set_num_threads(1)
    found = np.array([[costs(*kind, asked, seed) for kind in KINDS] for seed in range(asked.rounds)])
    table = Table.of_texts(["worlds"], ["steps/s", "ratio", "stepping worlds", "other collection", "updates"])
    whole = found.sum(axis=2)
    for i, (_, worlds, *_) in enumerate(KINDS):
        shares = [f"{100 * share:.0f} %" for share in (found[:, i] / whole[:, i, None]).mean(axis=0)]
        rate, ratio = (mean_and_error(each) for each in (1.0 / whole[:, i], whole[:, 1] / whole[:, i]))
        table.add(str(worlds), "{:.0f} ± {:.0f}".format(*rate), "{:.1f} ± {:.1f}".format(*ratio), *shares)
    out, place = Console(), machine()
    out.print(f"World steps per CPU second, {asked.rounds} experiments each, one thread; {place['processor']}.\n")
    out.print(table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
