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
from coopenv.observers.runner import run
from tests.helpers.mrclam_files import barrier_robots

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
    return status_of({"changed": changes, "barriers": barriers}[asked.what], asked)


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    found = argparse.ArgumentParser(prog="python -m benchmarks.planar", description=__doc__)
    found.add_argument("what", choices=("changed", "barriers"))
    found.add_argument("--data", type=Path, metavar="DIR", help="where mrclam_6 is")
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
