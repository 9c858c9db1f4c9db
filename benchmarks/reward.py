"""Both arms of `agents/reward_study.toml` in held-out worlds: does a reward for localisation pay?

After `python -m benchmarks.learning agents/reward_study.toml --out FOLDER`, `python -m benchmarks.reward FOLDER` prints
the figures of every seed, the means over seeds and their difference, with 95 % intervals (bootstrap over seeds and
worlds).
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import numpy as np

from benchmarks.learning.study import place_of, read_study
from coopenv.api.engine import Engine
from coopenv.base.installation import data_directory
from coopenv.evaluation import drive, held_out_seeds, score
from coopenv.evaluation.metrics import interval, scored_errors
from coopenv.policies import load_agent
from coopenv.scenario import load_scenario

SHARES = {"e50": 0.5, "e95": 0.95}
RESAMPLES = 500
Errors = tuple[np.ndarray, np.ndarray]
"""Position errors (M,), m, and the world (M,) of each."""


def figure(runs: Sequence[Errors], count: np.ndarray, share: float) -> float:
    """Return the mean over runs of a quantile of their errors, m, each world counted so many times, (W,)."""
    return float(np.mean([np.quantile(np.repeat(values, count[world]), share) for values, world in runs]))


def compared(arms: Sequence[Sequence[Errors]], worlds: int, share: float, seed: int = 0) -> tuple[np.ndarray, ...]:
    """Return the figures of two arms and their relative difference, (3,), and the ends of the intervals, (3,) each."""
    rng, rows = np.random.default_rng(seed), []
    for _ in range(RESAMPLES):
        count = np.bincount(rng.integers(0, worlds, worlds), minlength=worlds)
        chosen = [[runs[i] for i in rng.integers(0, len(runs), len(runs))] for runs in arms]
        rows.append([figure(runs, count, share) for runs in chosen])
    values = np.array([[figure(runs, np.ones(worlds, dtype=int), share) for runs in arms], *rows])
    table = np.column_stack([values, values[:, 0] / values[:, 1] - 1.0])
    low, high = zip(*(interval(column) for column in table[1:].T), strict=True)
    return table[0], np.array(low), np.array(high)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the comparison; return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.reward", description=__doc__)
    parser.add_argument("folder", type=Path, help="of the trained agents")
    parser.add_argument("--worlds", type=int, default=128)
    parser.add_argument("--seed-block", type=int, default=1097)
    asked = parser.parse_args(arguments)
    seeds, errors = held_out_seeds(asked.seed_block, asked.worlds), dict[str, list[Errors]]()
    for plan in read_study(data_directory("agents") / "reward_study.toml").plans:
        scenario = load_scenario(plan.environment)
        with closing(Engine(scenario, asked.worlds)) as engine:
            found = drive(engine, load_agent(asked.folder / place_of(plan), scenario), seeds)
        errors.setdefault(str(plan.arm), []).append(scored_errors(found))
        means = {result.metric: result.mean for result in score(found)}
        shown = " ".join(f"{name} {means[name]:.3f}" for name in ("arrival_rate", "collision_rate", "e50_m", "e95_m"))
        print(f"{plan.arm} {plan.seed}: {shown}", flush=True)
    for name, share in SHARES.items():
        rows = zip((*errors, "difference"), *compared([*errors.values()], asked.worlds, share), strict=True)
        print(name, "; ".join(f"{arm} {value:.3f} [{low:.3f}, {high:.3f}]" for arm, value, low, high in rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
