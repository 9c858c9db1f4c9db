"""`python -m benchmarks.training ENV ...`: vehicle steps per CPU second of `coopenv train`, beside SB3's own PPO.

Both train with the settings of `agents/train.toml`, without the clone, on one thread. They take turns; a round is one
update of each, and the first one is left out.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import closing
from functools import partial
from typing import Any

import numpy as np
import torch
from rich.console import Console
from stable_baselines3 import PPO
from stable_baselines3.common.policies import ActorCriticPolicy

from benchmarks.machine import machine
from coopenv.api.trainers.sb3 import ActingRowsBuffer
from coopenv.base.errors import CoopenvError
from coopenv.base.installation import data_directory
from coopenv.cli.options import parse_overrides
from coopenv.report.table import Table
from coopenv.training.command import possible
from coopenv.training.settings import SETTINGS_FILE, TrainingPlan, read_settings
from coopenv.training.trainer import Trainer

ENVIRONMENTS = ("open_square", "facade", "urban_crossing")


class OriginalTrainer(Trainer):
    """The same training with SB3's own classes."""

    kinds = (PPO, ActorCriticPolicy, ActingRowsBuffer)


def updates(kind: type[Trainer], plan: TrainingPlan) -> Iterator[tuple[float, float]]:
    """Yield, per update, CPU seconds per vehicle step, and those of them that the environment takes."""
    spent = 0.0

    def timed(step: Any) -> Any:
        nonlocal spent
        start = time.process_time()
        result = step()
        spent += time.process_time() - start
        return result

    with closing(kind(plan, possible(plan), threads=1)) as trainer:
        trainer.batch.step_wait = partial(timed, trainer.batch.step_wait)  # type: ignore[method-assign]
        trainer.begin()
        trainer.update()
        while True:
            before, steps, spent = trainer.cpu_seconds, trainer.status.steps, 0.0
            trainer.update()
            done = trainer.status.steps - steps
            yield (trainer.cpu_seconds - before) / done, spent / done


def measured(plan: TrainingPlan, rounds: int) -> np.ndarray:
    """Return what `updates` yields, (rounds, 2 trainers: SB3's and coopenv's, 2)."""
    kinds = [updates(kind, plan) for kind in (OriginalTrainer, Trainer)]
    return np.array([[next(kind) for kind in kinds] for _ in range(rounds)])


def mean_and_error(values: np.ndarray) -> tuple[float, float]:
    """Return the mean of values and its standard error."""
    return float(values.mean()), float(values.std(ddof=1) / math.sqrt(len(values)))


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; return the exit status: 0, or 2 after a mistake in the input."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.training", description=__doc__)
    parser.add_argument("environments", nargs="*", default=ENVIRONMENTS, metavar="ENV")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="override a scenario key")
    parser.add_argument("--rounds", type=int, default=5, choices=range(2, 1000), metavar="N", help="default: 5")
    asked = parser.parse_args(arguments)
    torch.set_num_threads(1)
    out, place = Console(), machine()
    heads = ["SB3\nsteps/s", "coopenv\nsteps/s", "\nratio", "trainer\nalone", "of SB3's,\nenvironment"]
    table = Table.of_texts(["\nenvironment"], heads)
    try:
        overrides = parse_overrides(asked.set)
        for name in asked.environments:
            settings = read_settings(data_directory("agents") / SETTINGS_FILE, None, name, clone=None)
            plan = TrainingPlan(name, settings.model_copy(update={"clone": None}), 0, overrides=overrides)
            whole, world = np.moveaxis(measured(plan, asked.rounds), 2, 0)
            rates = [f"{1e-3 / cost:.1f} k" for cost in whole.mean(axis=0)]
            ratios = [mean_and_error(cost[:, 0] / cost[:, 1]) for cost in (whole, whole - world)]
            shown = [f"{mean:.2f} ± {error:.2f}" for mean, error in ratios]
            table.add(name, *rates, *shown, f"{100 * (world / whole)[:, 0].mean():.0f} %")
    except CoopenvError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    out.print(f"Vehicle steps per CPU second, {asked.rounds} rounds, one thread; {place['processor']}.\n")
    out.print(table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
