"""`python -m benchmarks.declared`: accuracy and consistency with errors that cameras, maps and wheels have.

Worlds draw the errors, and the observers know their standard deviations. The scenes are `busy_intersection_tracking` at
20 Hz, at walking pace, and a road with two platoons at 25 m/s (`benchmarks.evidence`). Runs are judged from half of the
time on; standard errors over the seeds are in parentheses. The bound counts the same errors.
"""

import argparse
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np
from rich.console import Console

from benchmarks.evidence import BASE, road
from benchmarks.options import at_least
from coopenv.base.errors import check_one_of
from coopenv.base.format import in_parentheses
from coopenv.bench.observers.rows import mean_root, standard_error
from coopenv.observers import Run, run
from coopenv.observers.bound import cramer_rao
from coopenv.report.table import markdown
from coopenv.runs import record
from coopenv.scenario import Scenario, load_scenario

SECONDS = 24.0
SCENES = ("tracking", "road")
ERRORS: dict[str, dict[str, Any]] = {
    "none": {},
    "frames 5 ms late": {"camera.latency_error": 0.005},
    "frames 30 ms late": {"camera.latency_error": 0.03},
    "known age of 50 ms": {"camera.latency": 0.05},
    "jitter of 5 ms": {"camera.latency_jitter": 0.005},
    "map 5 cm off": {"map.accuracy": 0.05},
    "map 20 cm off": {"map.accuracy": 0.2},
    "3 mrad over 1 s": {"noise.bearing.correlated.std": 0.003, "noise.bearing.correlated.time": 1.0},
    "mounting walks": {"camera.extrinsics_walk": float(np.radians(0.1))},
    "scale of 0.5 %": {"noise.odometry_scale": 0.005},
}
"""Scenario keys of each error. The mounting walks by 0.1 deg per square root of a second."""


def scene_of(name: str, error: str) -> Scenario:
    """Return a scene with an error."""
    check_one_of("unknown error", error, ERRORS)
    keys = {"horizon": SECONDS, **ERRORS[error]}
    if name == "road":
        return road() | keys
    return load_scenario(BASE, {"rates.camera": 20.0, "rates.odometry": 20.0, **keys})


def overconfident(found: Run, judged: Any) -> float:
    """Return the share of errors of position above five stated standard deviations, in percent."""
    std = np.sqrt(np.trace(found.covariance[judged][..., 3:, 3:], axis1=-2, axis2=-1))
    return 100.0 * float((found.position_error[judged] > 5.0 * std).mean())


def rows_of(scene: str, error: str, observers: Sequence[str], seeds: Sequence[int]) -> list[list[str]]:
    """Return one row for each observer."""
    recordings = [record(scene_of(scene, error), seed) for seed in seeds]
    judged = recordings[0].t >= SECONDS / 2
    bounds = np.array([np.mean(cramer_rao(recording).position[judged] ** 2, axis=0) for recording in recordings])
    rows = []
    for observer in observers:
        runs = [run(observer, recording) for recording in recordings]
        squares = np.array([np.mean(found.position_error[judged] ** 2, axis=0) for found in runs])
        anees = np.array([found.anees_in(judged) for found in runs])
        means = anees.mean(axis=0)
        rows.append(
            [
                scene,
                error,
                observer,
                in_parentheses(*mean_root(squares)),
                in_parentheses(*mean_root(bounds)),
                in_parentheses(float(anees.mean()), standard_error(anees.mean(axis=1))),
                in_parentheses(float(means.min()), standard_error(anees[:, np.argmin(means)])),
                in_parentheses(float(means.max()), standard_error(anees[:, np.argmax(means)])),
                f"{np.mean([overconfident(found, judged) for found in runs]):.2g} %",
            ]
        )
    return rows


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table; return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.declared", description=__doc__)
    parser.add_argument("--seeds", type=at_least(1), default=8, help="number of seeds (default: 8)")
    parser.add_argument("--first", type=at_least(0), default=500, help="the first seed (default: 500)")
    parser.add_argument("--observers", nargs="+", default=["schmidt_kalman", "self_calibrating", "mekf_covariance"])
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=[*SCENES])
    parser.add_argument("--errors", nargs="+", default=[*ERRORS], help=f"of {', '.join(ERRORS)} (default: every one)")
    asked = parser.parse_args(arguments)
    seeds, rows = range(asked.first, asked.first + asked.seeds), []
    for scene in asked.scenes:
        for error in asked.errors:
            rows += rows_of(scene, error, asked.observers, seeds)
            print(*rows[-len(asked.observers) :], sep="\n", flush=True, file=sys.stderr)
    headings = ["scene", "error", "observer", "RMSE, m", "bound, m", "ANEES / 6", "least", "largest", "above 5 std"]
    Console(markup=False, highlight=False, width=200).print(markdown(headings, rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
