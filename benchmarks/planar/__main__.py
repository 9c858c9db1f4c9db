"""`python -m benchmarks.planar`: observers of recorded robots on changed recordings and behind barriers."""

from __future__ import annotations

import argparse
import sys
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from benchmarks.options import status_of
from benchmarks.planar.changes import changed, clocks, drifting, hidden, misread, odometry, part
from coopenv.mrclam.recording import VARIANTS, Dataset, load_dataset, recording_of
from coopenv.observers.runner import Run, run
from coopenv.report.table import markdown
from tests.helpers.mrclam_files import barrier_robots

TUNED_ON = "6"
"""The sub-dataset that noise and the wheels' response were fitted to."""
SETTLED = 10.0
"""Time after a robot's first known pose from which its errors are judged, s."""

CHANGES: dict[str, Callable[[Dataset, int], Dataset]] = {
    "8.3 Hz, turns .7, hidden": lambda d, s: changed(d, s, odometry(1 / 0.7, rate=8.3), hidden((5, 40), (5, 23))),
    "8.3 Hz, turns .62, mostly hidden": lambda d, s: changed(
        d, s, odometry(1 / 0.62, rate=8.3), hidden((1, 8), (5, 23))
    ),
    "8.3 Hz, turns .75, speed .96": lambda d, s: changed(d, s, odometry(1 / 0.75, 1 / 0.96, rate=8.3)),
    "2 % wrong, clocks .1 s off": lambda d, s: changed(d, s, misread(0.02), clocks(0.1)),
    "drift .01 rad/s": lambda d, s: changed(d, s, drifting(0.01)),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; return the exit status: 0, or 2 after a mistake in the input."""
    asked = parser().parse_args(arguments)
    warnings.simplefilter("ignore")
    return status_of({"changed": changes, "barriers": barriers, "recorded": recorded}[asked.what], asked)


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    found = argparse.ArgumentParser(prog="python -m benchmarks.planar", description=__doc__)
    found.add_argument("what", choices=("changed", "barriers", "recorded"))
    found.add_argument("--data", type=Path, metavar="DIR", help="where the sub-datasets are")
    found.add_argument("--sets", default="6,7,9", help="sub-datasets of `recorded`, with commas (default: 6,7,9)")
    found.add_argument("--variants", default=",".join(VARIANTS), help="of `recorded`, with commas")
    found.add_argument("--start", type=float, default=0.0, help="of the part of mrclam_6, s (default: 0)")
    found.add_argument("--seconds", type=float, default=250.0, help="how long (default: 250)")
    found.add_argument("--seeds", type=lambda text: [int(n) for n in text.split(",")], default=[0], help="with commas")
    found.add_argument("--turns", type=float, default=0.7, help="true turns over commanded ones (default: 0.7)")
    found.add_argument("--observers", default="mekf_covariance,schmidt_kalman,self_calibrating", help="with commas")
    found.add_argument("--only", default="", help="rows whose name contains this")
    return found


def changes(asked: argparse.Namespace) -> None:
    """Print the errors on parts of `mrclam_6`, changed."""
    data = part(load_dataset("mrclam_6", asked.data), asked.start, asked.seconds)
    for name, change in CHANGES.items():
        if asked.only in name:
            for seed in asked.seeds:
                _compare(f"{name}, seed {seed}", change(data, seed), asked.observers.split(","))


def barriers(asked: argparse.Namespace) -> None:
    """Print the errors of simulated robots behind barriers."""
    for seed in asked.seeds:
        data = barrier_robots(seed, asked.seconds, asked.turns)
        _compare(f"seed {seed}, turns {asked.turns}", data, asked.observers.split(","))


def recorded(asked: argparse.Namespace) -> None:
    """Print a table of recordings: errors from 10 s after the first known pose on, and how many ticks were judged."""
    rows = []
    for number in asked.sets.split(","):
        name = f"mrclam_{number}"
        data = part(load_dataset(name, asked.data), asked.start, asked.seconds)
        for variant in asked.variants.split(","):
            for observer in asked.observers.split(","):
                cells = [name, "tuned on" if number == TUNED_ON else "not", variant, observer]
                rows.append(cells + _judged(run(observer, recording_of(data, variant))))
                print(rows[-1], file=sys.stderr, flush=True)
    figures = ["judged ticks", "RMSE, m", "worst", "median, m", "worst ", "ANEES", "failure"]
    print(markdown(["recording", "noise", "variant", "observer", *figures], rows))


def _judged(result: Run) -> list[str]:
    """Return judged ticks by robot, mean and worst RMSE and median of the robots, m, range of ANEES, and failure."""
    error, known = result.position_error, np.isfinite(result.position_error)
    first = result.t[known.argmax(axis=0)]  # a start is dead reckoning back from there, so that its error is zero
    judged = known & (result.t[:, None] >= first + SETTLED)
    robots = np.flatnonzero(judged.any(axis=0))
    rmse = [float(np.sqrt(np.mean(error[judged[:, i], i] ** 2))) for i in robots]
    median = [float(np.median(error[judged[:, i], i])) for i in robots]
    anees = [float(result.anees_in(judged[:, i])[i]) for i in robots]
    ticks = ", ".join(str(count) for count in judged.sum(axis=0))
    figures = [np.mean(rmse), max(rmse), np.mean(median), max(median)]
    numbers = [f"{figure:.3f}" for figure in figures]
    return [ticks, *numbers, f"{min(anees):.2f} to {max(anees):.2f}", result.failure]


def _compare(name: str, data: Dataset, observers: Sequence[str]) -> None:
    for variant in VARIANTS:
        recording = recording_of(data, variant)
        for observer in observers:
            result = run(observer, recording)
            error, anees = result.position_rmse(recording.dt), result.anees(recording.dt)
            deviation = np.std(error, ddof=1) / np.sqrt(len(error))
            where = f"{error.mean():.3f} +- {deviation:.3f} m, ANEES {anees.mean():.2f}, at most {anees.max():.1f}"
            print(f"{name}, {variant}, {observer}: {where} {result.failure}".rstrip(), flush=True)


if __name__ == "__main__":
    sys.exit(main())
