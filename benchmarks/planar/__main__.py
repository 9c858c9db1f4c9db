"""`python -m benchmarks.planar`: planar observers on changed recordings, behind barriers, with lying senders."""

from __future__ import annotations

import argparse
import sys
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from benchmarks.options import status_of
from benchmarks.planar.changes import blindfolded, changed, clocks, drifting, hidden, misread, odometry, part
from benchmarks.planar.lies import Drifting, Replaying
from coopenv.estimation.poses import Array
from coopenv.mrclam.planar import LEAST_LOST_STD, PlanarEkf, PlanarRobust
from coopenv.mrclam.recording import VARIANTS, Dataset, load_dataset, recording_of
from coopenv.observers.recording import Recording
from coopenv.observers.runner import Run, run
from tests.helpers.mrclam_files import barrier_robots, carried_off

CHANGES: dict[str, Callable[[Dataset, int], Dataset]] = {
    "8.3 Hz, turns .7, hidden": lambda d, s: changed(d, s, odometry(1 / 0.7, rate=8.3), hidden((5, 40), (5, 23))),
    "8.3 Hz, turns .62, mostly hidden": lambda d, s: changed(
        d, s, odometry(1 / 0.62, rate=8.3), hidden((1, 8), (5, 23))
    ),
    "8.3 Hz, turns .75, speed .96": lambda d, s: changed(d, s, odometry(1 / 0.75, 1 / 0.96, rate=8.3)),
    "2 % wrong, clocks .1 s off": lambda d, s: changed(d, s, misread(0.02), clocks(0.1)),
    "drift .01 rad/s": lambda d, s: changed(d, s, drifting(0.01)),
}
LIES: dict[str, Callable[[list[int]], Drifting | Replaying]] = {
    "jump 5 m": lambda who: Drifting(who, 5.0, 0.0),
    "drift 5 cm/s": lambda who: Drifting(who, 0.0, 0.05),
    "3 m at once": lambda who: Drifting(who, 3.0, 0.0, since=0.0),
    "replay 1 s": lambda who: Replaying(who, 10),
}
CARRIED = 2  # the robot that is
LIED_FROM = 15.0  # s, from when on errors count with a lying sender
WAYS: dict[str, tuple[Callable[[Dataset], Recording], int]] = {
    "all see landmarks, 1 lies": (lambda d: recording_of(d, "landmarks+robots"), 0),
    "1 to 3 see landmarks, 1 lies": (lambda d: recording_of(blindfolded(d, 4, 5), "landmarks+robots"), 0),
    "1 and 2 see landmarks, 3 lies": (lambda d: recording_of(d, "blind"), 2),
    "1 and 2 see landmarks, 1 lies": (lambda d: recording_of(d, "blind"), 0),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; return the exit status: 0, or 2 after a mistake in the input."""
    asked = parser().parse_args(arguments)
    warnings.simplefilter("ignore")
    return status_of({"changed": changes, "barriers": barriers, "lies": lies, "carried": carried}[asked.what], asked)


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    found = argparse.ArgumentParser(prog="python -m benchmarks.planar", description=__doc__)
    found.add_argument("what", choices=("changed", "barriers", "lies", "carried"))
    found.add_argument("--data", type=Path, metavar="DIR", help="where mrclam_6 is (`changed`; `lies`: else simulated)")
    found.add_argument("--start", type=float, default=0.0, help="of the part of mrclam_6, s (default: 0)")
    found.add_argument("--seconds", type=float, default=250.0, help="how long (default: 250)")
    found.add_argument("--seeds", type=lambda text: [int(n) for n in text.split(",")], default=[0], help="with commas")
    found.add_argument(
        "--turns", type=float, default=0.7, help="true turns of those told, behind barriers (default: 0.7)"
    )
    found.add_argument("--only", default="", help="rows whose name contains this")
    return found


def changes(asked: argparse.Namespace) -> None:
    """Print how both do on parts of `mrclam_6`, changed."""
    data = part(load_dataset("mrclam_6", asked.data), asked.start, asked.seconds)
    for name, change in CHANGES.items():
        if asked.only in name:
            for seed in asked.seeds:
                _compare(f"{name}, seed {seed}", change(data, seed))


def barriers(asked: argparse.Namespace) -> None:
    """Print how both do on simulated robots behind barriers."""
    for seed in asked.seeds:
        _compare(f"seed {seed}, turns {asked.turns}", barrier_robots(seed, asked.seconds, asked.turns))


def lies(asked: argparse.Namespace) -> None:
    """Print what lies cost the honest ones: their error over what it is without."""
    for seed in asked.seeds:
        if asked.data is None:
            data = barrier_robots(seed, asked.seconds, asked.turns)
        else:
            data = part(load_dataset("mrclam_6", asked.data), asked.start, asked.seconds)
        for way, (recorded, who) in WAYS.items():
            if asked.only in way:
                recording, honest = recorded(data), np.arange(5) != who
                before = _rmse(run(PlanarRobust, recording), LIED_FROM)[honest]
                for name, lie in LIES.items():
                    result = run(PlanarRobust, recording, lie([who]))
                    after = _rmse(result, LIED_FROM)[honest]
                    ratio, anees = after / before, _numbers(result.anees(LIED_FROM)[honest], 1)
                    cost = f"times {after.mean() / before.mean():.2f}, worst robot {ratio.max():.2f}"
                    print(f"seed {seed}, {way}, {name}: {before.mean():.3f} m, {cost}, ANEES {anees}", flush=True)


def carried(asked: argparse.Namespace) -> None:
    """Print how a simulated robot that is carried off, unfelt, after 50 s finds out, and itself."""
    for seed in asked.seeds:
        recording = carried_off(seed, CARRIED, 50.0, asked.seconds)
        result = run(PlanarRobust, recording)
        std = np.sqrt(result.covariance[:, CARRIED, 3, 3] + result.covariance[:, CARRIED, 4, 4])
        lost = result.t[(result.t >= 50.0) & (std > LEAST_LOST_STD)]
        what = f"lost from {lost[0]:.1f} to {lost[-1]:.1f} s" if len(lost) else "never lost"
        wrong = result.t[(result.t >= 50.0) & (result.position_error[:, CARRIED] > 0.5)]
        print(f"seed {seed}: {what}, over 0.5 m until {wrong[-1] if len(wrong) else 50.0:.1f} s, "
              f"{_rmse(result, asked.seconds - 20.0)[CARRIED]:.3f} m in the last 20 s", flush=True)  # fmt: skip


def _compare(name: str, data: Dataset) -> None:
    for variant in VARIANTS:
        recording = recording_of(data, variant)
        for kind in (PlanarEkf, PlanarRobust):
            result = run(kind, recording)
            error, anees = _rmse(result, recording.dt), result.anees(after=recording.dt)
            where = f"{error.mean():.3f} m ({_numbers(error)}), ANEES {anees.mean():.2f} ({_numbers(anees, 1)})"
            print(f"{name}, {variant}, {kind.__name__}: {where} {result.failure or ''}".rstrip(), flush=True)


def _rmse(result: Run, after: float) -> Array:
    at = result.t >= after
    return np.asarray(np.sqrt(np.nanmean(np.where(at[:, None], result.position_error, np.nan) ** 2, axis=0)))


def _numbers(values: Array, digits: int = 3) -> str:
    return " ".join(f"{value:.{digits}f}" for value in values)


if __name__ == "__main__":
    sys.exit(main())
