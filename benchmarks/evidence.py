"""`python -m benchmarks.evidence`: observers in the parametric scenes, and under errors that no scenario declares.

Both tables are Markdown. With `--page` they replace the section of that page between the marks of their name.
"""

from __future__ import annotations

import argparse
import sys
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

import coopenv
from coopenv.base.errors import CoopenvError
from coopenv.base.files import replace_text
from coopenv.base.format import in_parentheses
from coopenv.base.installation import scenario_path
from coopenv.bench.observers.faults import variant_of
from coopenv.bench.observers.rows import standard_error
from coopenv.bench.pages import table
from coopenv.estimation.poses import Array
from coopenv.observers import run
from coopenv.observers.recording import Recording
from coopenv.runs import record
from coopenv.scenario import Scenario, load_scenario, parse_scenario

OBSERVERS = ("riccati", "schmidt_kalman", "robust")
"""In the parametric scenes."""
SCENES = ("busy_intersection_tracking", "ring:5", "lane:8", "roots:10", "random:12,seed=1", "tree:15")
HORIZON = 50.0
"""s, of the parametric scenes."""
WINDOWS = (5.0, 10.0, 20.0, 35.0)
"""s."""
CHANGED_OBSERVERS = ("riccati", "mekf_covariance", "schmidt_kalman", "robust")
"""In changed recordings."""
CHANGED_HORIZON = 30.0
"""s, of the changed recordings."""
JUDGED_FROM = 15.0
"""s, in changed recordings."""
STEP_AT = 12.0
"""s, at which the gyro bias steps."""
ANGLE = np.arctan2(0.6, 0.8)
"""rad, of a landmark's error in the map."""

BASE = "busy_intersection_tracking"
"""Whose noise, initial errors and observer settings the road has."""


def road() -> Scenario:
    """Return two platoons that meet on a road at 25 m/s each, with cameras of 10 Hz and 34 landmarks."""
    keys = tomllib.loads(scenario_path(BASE).read_text(encoding="utf-8"))
    defaults = keys.pop("vehicle_defaults")
    sides = [(x, 80.0 * n, z) for n in range(17) for x, z in ((-9.0, 4.0), (9.0, 6.0))]
    marks = [f"L{n}" for n in range(1, len(sides) + 1)]
    lines = [(2.0, 0.0, 25.0, marks), (2.0, -20.0, 25.0, ["vehicle_1", *marks[8:10]])]
    lines += [(2.0, -20.0 * n, 25.0, [f"vehicle_{n - 1}", f"vehicle_{n}", *marks[8:10]]) for n in (2, 3)]
    lines += [(-2.0, 1200.0, -25.0, marks[:20]), (-2.0, 1222.0, -25.0, ["vehicle_1", "vehicle_2", "vehicle_5", "L4"])]
    lines += [(-2.0, 1243.0, -25.0, ["vehicle_2", "vehicle_3", "vehicle_5", "vehicle_6"])]
    keys |= {
        "title": "Road",
        "horizon": CHANGED_HORIZON,
        "roads": [{"start": [0.0, -80.0], "end": [0.0, 1300.0], "width": 8.0}],
        "landmarks": [{"name": name, "position": list(side)} for name, side in zip(marks, sides, strict=True)],
        "vehicles": [
            defaults
            | {
                "initial_pose": {"position": [x, y, 1.5]},
                "motion": {"kind": "constant", "linear": [0.0, speed, 0.0]},
                "neighbours": neighbours,
            }
            for x, y, speed, neighbours in lines
        ],
    }
    keys["rates"] |= {"camera": 10.0, "odometry": 100.0}
    return parse_scenario(keys, "road")


def tracking() -> Scenario:
    """Return five vehicles at walking pace with three landmarks."""
    return load_scenario(BASE, {"horizon": CHANGED_HORIZON})


CHANGES = {
    "none": "",
    "one landmark off by 0.3 m": f"map_error=LANDMARK:0.3,angle={ANGLE}",
    "one landmark off by 3 m": f"map_error=LANDMARK:3.0,angle={ANGLE}",
    "gyro bias steps to 1 deg/s at 12 s": f"gyro_step={np.deg2rad(1.0)}@{STEP_AT}",
    "gyro bias steps to 3 deg/s at 12.27 s": f"gyro_step={np.deg2rad(3.0)}@12.27",
    "cameras turn by 1 deg at 12 s": f"camera_step={np.deg2rad(1.0)}@{STEP_AT}",
    "the second camera turns by 3 deg at 12 s": f"vehicle_2:camera_step={np.deg2rad(3.0)}@{STEP_AT}",
    "odometry scale error grows to 10 % in 30 s": "scale_drift=0.1",
    "10 % of the bearings random": "random_bearings=0.1",
}
"""Faults of `coopenv.bench.observers.faults`."""


def changed(recording: Recording, fault: str, seed: int) -> Recording:
    """Return a recording with a fault, in which LANDMARK is the second one of three, the tenth one of 34."""
    landmark = recording.setups[0].target_names[1 if recording.landmarks.shape[1] < 10 else 9]
    return variant_of(fault.replace("LANDMARK", landmark), "changed").applied(recording, seed)


def scenes(seeds: Sequence[int], jobs: int) -> str:
    """Return the table of the parametric scenes: ratio of the RMSE to the ancestors' bound, and ANEES."""
    rows = []
    for scene in SCENES:
        found = coopenv.compare(OBSERVERS, scene, seeds, overrides={"horizon": HORIZON}, windows=WINDOWS, jobs=jobs)
        for observer in OBSERVERS:
            cells = []
            for name in (f"{WINDOWS[0]:g}-{WINDOWS[1]:g} s", "steady"):
                own = [row for row in found.window_rows if (row.observer, row.window) == (observer, name)]
                own.sort(key=lambda row: row.ratio_to_bound_ancestors)
                for row in (own[len(own) // 2], own[-1]):
                    cells.append(in_parentheses(row.ratio_to_bound_ancestors, row.ratio_to_bound_ancestors_se))
            own.sort(key=lambda row: row.anees)
            cells += [in_parentheses(row.anees, row.anees_se) for row in (own[0], own[-1])]
            rows.append([f"`{scene}`", f"`{observer}`", *cells])
            print(" | ".join(rows[-1]), file=sys.stderr, flush=True)
    heads = ["scene", "observer", "5-10 s: median", "worst", "after 35 s: median", "worst", "ANEES: least", "largest"]
    return table(heads, rows)


def undeclared(seeds: Sequence[int], jobs: int) -> str:
    """Return the table of errors that the scenario does not declare: mean RMSE over the vehicles, m, by observer."""
    rows = []
    for scene, scenario in (("tracking", tracking()), ("road", road())):
        recordings = [record(scenario, seed) for seed in seeds]
        for name, fault in CHANGES.items():
            cells = []
            for observer in CHANGED_OBSERVERS:
                errors, anees = [], []
                for seed, recording in zip(seeds, recordings, strict=True):
                    found = run(observer, changed(recording, fault, seed))
                    errors.append(found.position_rmse(JUDGED_FROM).mean())
                    anees.append(found.anees(JUDGED_FROM))
                cells.append(f"{_mean(np.array(errors))} ({_compact(np.mean(anees, axis=0).max())})")
            rows.append([scene, name, *cells])
            print(" | ".join(rows[-1]), file=sys.stderr, flush=True)
    return table(["scene", "error", *(f"`{observer}`" for observer in CHANGED_OBSERVERS)], rows)


def _mean(values: Array) -> str:
    return in_parentheses(float(values.mean()), standard_error(values))


def _compact(value: float) -> str:
    return f"{value:.1f}" if value < 100.0 else f"{value:.0f}" if value < 1e5 else f"{value:.0e}"


PARTS: dict[str, Callable[[Sequence[int], int], str]] = {"scenes": scenes, "undeclared": undeclared}


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; return the exit status: 0, or 2 after a mistake in the input."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.evidence", description=__doc__)
    parser.add_argument("what", choices=tuple(PARTS))
    parser.add_argument("--seeds", type=int, default=8, help="number of seeds (default: 8)")
    parser.add_argument("--first", type=int, default=50, help="the first seed (default: 50)")
    parser.add_argument("--jobs", type=int, default=1, help="number of processes (default: 1)")
    parser.add_argument("--page", type=Path, help="page whose section is replaced")
    asked = parser.parse_args(arguments)
    try:
        text = PARTS[asked.what](range(asked.first, asked.first + asked.seeds), asked.jobs)
    except CoopenvError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(text)
    if asked.page is not None:
        begin, end = (f"<!-- {asked.what}: {edge} -->" for edge in ("begin", "end"))
        page = asked.page.read_text(encoding="utf-8")
        if begin not in page or end not in page:
            print(f"error: {asked.page}: expected the marks {begin} and {end}", file=sys.stderr)
            return 2
        head, rest = page.split(begin, 1)
        replace_text(asked.page, f"{head}{begin}\n\n{text.rstrip()}\n\n{end}{rest.split(end, 1)[1]}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
