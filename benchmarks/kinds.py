"""`python -m benchmarks.kinds`: accuracy and consistency of observers with each kind of measurement.

Worlds of `busy_intersection_tracking` at 20 Hz, judged from half of the run on. Sensors measure landmarks and vehicles
ten times a second with their default noise: the camera alone, every kind alone without a camera, radios between
vehicles beside the camera, and all together. Standard errors over the seeds are in parentheses.
"""

import argparse
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np
from rich.console import Console

import coopenv
from benchmarks.options import at_least
from coopenv.base.errors import check_one_of
from coopenv.base.format import in_parentheses
from coopenv.bench.observers.rows import Measured, mean_root, standard_error
from coopenv.measurements.sensor import kind_of
from coopenv.measurements.table import KINDS
from coopenv.report.table import markdown

SECONDS = 24.0
RATES = {"rates.camera": 20.0, "rates.odometry": 20.0, "horizon": SECONDS}
CAMERA, BESIDE, EVERYTHING = "camera", "camera + range", "all"


def section(kind: str) -> dict[str, Any]:
    """Return the keys of a sensor of a kind towards landmarks and vehicles."""
    targets = {"towards": ["landmarks", "vehicles"]} if kind_of(kind).has_target else {}
    return {"kind": kind, "rate": 10.0, **targets}


def sensor_sets() -> dict[str, dict[str, Any]]:
    """Return the scenario keys of every set of sensors by its name."""
    sets: dict[str, dict[str, Any]] = {CAMERA: {}}
    sets |= {kind: {"camera.model": "none", "sensors": [section(kind)]} for kind in KINDS}
    sets[BESIDE] = {"sensors": [section("range") | {"towards": ["vehicles"]}]}
    sets[EVERYTHING] = {"sensors": [*map(section, KINDS)]}
    return sets


def cells(found: coopenv.Comparison, observer: str, variant: str) -> list[str]:
    """Return the ratio to the bound, its largest, ANEES / 6, its largest and least, and the last vehicle's RMSE."""
    own = [sample for sample in found.samples if sample.observer == observer]
    squares = np.array([sample.measured("position_mse")[:, -1] for sample in own])
    anees = np.array([sample.measured("anees")[:, -1] for sample in own])
    bounds = np.sqrt(np.mean([sample.scene.bounds[1, :, -1] for sample in own], axis=0))
    ratios = squares / bounds**2
    each = [mean_root(ratios[:, [i]]) for i in range(len(bounds))]
    means = [Measured(float(column.mean()), standard_error(column)) for column in anees.T]
    return [
        in_parentheses(*mean_root(ratios)),
        in_parentheses(*max(each)),
        in_parentheses(float(anees.mean()), standard_error(anees.mean(axis=1))),
        in_parentheses(*min(means)),
        in_parentheses(*max(means)),
        in_parentheses(*mean_root(squares[:, [-1]])),
    ]


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table; return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.kinds", description=__doc__)
    sets = sensor_sets()
    parser.add_argument("--seeds", type=at_least(1), default=20, help="number of seeds (default: 20)")
    parser.add_argument("--first", type=at_least(0), default=300, help="the first seed (default: 300)")
    parser.add_argument("--observers", nargs="+", default=["robust", "schmidt_kalman"])
    parser.add_argument("--kinds", nargs="+", default=[*sets], help=f"of {', '.join(sets)} (default: every one)")
    asked = parser.parse_args(arguments)
    rows = []
    for name in asked.kinds:
        check_one_of("unknown set of sensors", name, sets)
        found = coopenv.compare(
            asked.observers,
            "busy_intersection_tracking",
            range(asked.first, asked.first + asked.seeds),
            overrides=RATES | sets[name],
            steady_from=SECONDS / 2,
        )
        rows += [[name, observer, *cells(found, observer, name)] for observer in asked.observers]
        print(*rows[-len(asked.observers) :], sep="\n", flush=True, file=sys.stderr)
    headings = ["sensors", "observer", "RMSE / bound", "worst vehicle", "ANEES / 6", "least", "largest", "f5, m"]
    Console(markup=False, highlight=False, width=200).print(markdown(headings, rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
