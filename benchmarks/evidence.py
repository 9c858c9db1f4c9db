"""`python -m benchmarks.evidence`: observers in the parametric scenes, and under errors that no scenario declares.

The tables are Markdown. With `--page` they replace the section of that page between the marks of their name.
"""

from __future__ import annotations

import argparse
import sys
import tomllib
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import coopenv
from benchmarks.options import at_least
from coopenv.base.errors import CoopenvError
from coopenv.base.files import replace_text
from coopenv.base.format import in_parentheses
from coopenv.base.installation import scenario_path
from coopenv.bench.observers.faults import variant_of
from coopenv.bench.observers.rows import standard_error
from coopenv.estimation.poses import Array
from coopenv.observers import run
from coopenv.observers.recording import Recording
from coopenv.observers.robust import constants
from coopenv.report.table import markdown
from coopenv.runs import record
from coopenv.scenario import Scenario, load_scenario, parse_scenario

OBSERVERS = ("riccati", "schmidt_kalman", "robust")
"""In the parametric scenes."""
SCENES = ("busy_intersection_tracking", "ring:5", "lane:8", "roots:10", "random:12,seed=1", "tree:15")
HORIZON = 50.0
"""s, of the parametric scenes."""
WINDOWS = (5.0, 10.0, 20.0, 35.0)
"""s."""
CHANGED_OBSERVERS = ("schmidt_kalman", "robust")
"""In changed recordings."""
CHANGED_HORIZON = 30.0
"""s, of the changed recordings."""
JUDGED_FROM = 15.0
"""s, in changed recordings."""
MERGING_FROM = 4.0
"""s, from which the merging platoons are judged."""
FAULT_SHARE = 0.4
"""Of a run, after which lies begin and protection levels are judged."""
OVERCONFIDENT = (5.0, 1.0)
"""m: error above, and stated deviation below which an estimate is overconfident."""
STEP_AT = 12.0
"""s, at which the gyro bias steps."""
ANGLE = np.arctan2(0.6, 0.8)
"""rad, of a landmark's error in the map."""

RAMP = np.radians(6.0)
"""Angle between the merging platoons."""

BASE = "busy_intersection_tracking"
"""Whose noise, initial errors and observer settings the platoons have."""


def road() -> Scenario:
    """Return two platoons that meet on a road at 25 m/s each, with cameras of 10 Hz and 34 landmarks."""
    sides = [(x, 80.0 * n, z) for n in range(17) for x, z in ((-9.0, 4.0), (9.0, 6.0))]
    marks = [f"L{n}" for n in range(1, len(sides) + 1)]
    north, south = (0.0, 25.0), (0.0, -25.0)
    lines = [(2.0, 0.0, north, marks), (2.0, -20.0, north, ["vehicle_1", *marks[8:10]])]
    lines += [(2.0, -20.0 * n, north, [f"vehicle_{n - 1}", f"vehicle_{n}", *marks[8:10]]) for n in (2, 3)]
    lines += [(-2.0, 1200.0, south, marks[:20]), (-2.0, 1222.0, south, ["vehicle_1", "vehicle_2", "vehicle_5", "L4"])]
    lines += [(-2.0, 1243.0, south, ["vehicle_2", "vehicle_3", "vehicle_5", "vehicle_6"])]
    return straight("road", CHANGED_HORIZON, (-80.0, 1300.0), dict(zip(marks, sides, strict=True)), lines)


def merging() -> Scenario:
    """Return two platoons that merge at 20 m/s, with cameras of 10 Hz and landmarks that most vehicles leave behind."""
    sides = [(x, 60.0 * n, z) for n in range(9) for x, z in ((-8.0, 4.0), (8.0, 6.0))]
    marks = [f"L{n}" for n in range(1, len(sides) + 1)]
    north, ramp = (0.0, 20.0), (-20.0 * np.sin(RAMP), 20.0 * np.cos(RAMP))
    lines = [(0.0, 60.0, north, marks), (0.0, 46.0, north, ["vehicle_1", *marks[:3]])]
    lines += [(0.0, 60.0 - 14.0 * n, north, [f"vehicle_{n - 1}", f"vehicle_{n}", *marks[:2]]) for n in range(2, 6)]
    x = 3.5 - 9.0 * ramp[0]  # beside the other platoon after 9 s
    lines += [(x, 53.0, ramp, ["vehicle_1", "vehicle_2", "L5"])]
    lines += [(x, 53.0 - 14.0 * n, ramp, [f"vehicle_{n + k}" for k in (6, 2, 3)]) for n in (1, 2, 3)]
    return straight("merging", 18.0, (-80.0, 600.0), dict(zip(marks, sides, strict=True)), lines)


Line = tuple[float, float, tuple[float, float], list[str]]
"""x and y, m, velocity, m/s, and neighbours of a vehicle."""


def straight(
    name: str,
    horizon: float,
    ends: tuple[float, float],
    landmarks: Mapping[str, Sequence[float]],
    lines: Sequence[Line],
) -> Scenario:
    """Return vehicles with constant velocities beside a straight road."""
    keys = tomllib.loads(scenario_path(BASE).read_text(encoding="utf-8"))
    defaults = keys.pop("vehicle_defaults")
    keys |= {
        "title": name.capitalize(),
        "horizon": horizon,
        "roads": [{"start": [0.0, ends[0]], "end": [0.0, ends[1]], "width": 8.0}],
        "landmarks": [{"name": mark, "position": list(place)} for mark, place in landmarks.items()],
        "vehicles": [
            defaults
            | {
                "initial_pose": {"position": [x, y, 1.5]},
                "motion": {"kind": "constant", "linear": [*velocity, 0.0]},
                "neighbours": neighbours,
            }
            for x, y, velocity, neighbours in lines
        ],
    }
    keys["rates"] |= {"camera": 10.0, "odometry": 100.0}
    return parse_scenario(keys, name)


def tracking() -> Scenario:
    """Return five vehicles at walking pace with three landmarks."""
    return load_scenario(BASE, {"horizon": CHANGED_HORIZON})


CHANGES = {
    "none": "",
    "one landmark off by 0.3 m": f"map_error=LANDMARK:0.3,angle={ANGLE}",
    "one landmark off by 3 m": f"map_error=LANDMARK:3.0,angle={ANGLE}",
    "one landmark off by 3 m from 12 s": f"map_error=LANDMARK:3.0@{STEP_AT},angle={ANGLE}",
    "gyro bias steps to 1 deg/s at 12 s": f"gyro_step={np.deg2rad(1.0)}@{STEP_AT}",
    "gyro bias steps to 3 deg/s at 12.27 s": f"gyro_step={np.deg2rad(3.0)}@12.27",
    "cameras turn by 1 deg at 12 s": f"camera_step={np.deg2rad(1.0)}@{STEP_AT}",
    "odometry scale error grows to 10 % in 30 s": "scale_drift=0.1",
    "10 % of the bearings random": "random_bearings=0.1",
    "5 % of the bearings swapped": "wrong_association=0.05",
    "focal length 5 % too large": "focal_step=0.05@0",
    "initial estimates off by 3 m": "prior_error=3",
}
"""Faults of `coopenv.bench.observers.faults`. A focal length is that of cameras which look ahead."""


IN_TURN = "one landmark in turn off by {} m"
MERGING_CHANGES = {
    "none": "",
    **{IN_TURN.format(size): f"map_error=IN_TURN:{size},angle={ANGLE}" for size in ("0.5", "1", "3")},
    "odometry scale error grows to 4 %": "scale_drift=0.04",
}
LEVEL_CHANGES = {
    "none": "",
    IN_TURN.format("3"): f"map_error=IN_TURN:3,angle={ANGLE}",
    "the second vehicle lies by 1 m": f"vehicle_2:lie=jump:1@{FAULT_SHARE:.0%}",
    "odometry scale error grows to 10 %": "scale_drift=0.1",
    "the first two collude, 5 m": f"vehicle_1,vehicle_2:lie=collude:5@{FAULT_SHARE:.0%}",
}


def changed(recording: Recording, fault: str, seed: int) -> Recording:
    """Return a recording with a fault.

    In its text LANDMARK is the second landmark of three, or the tenth of 34; IN_TURN changes with the seed, among those
    that vehicles other than the first one see.
    """
    names, count = recording.setups[0].target_names, recording.landmarks.shape[1]
    seen = sorted({int(target) for setup in recording.setups[1:] for target in setup.targets if target < count})
    words = {"LANDMARK": names[1 if count < 10 else 9], "IN_TURN": names[seen[seed % len(seen)]]}
    for word, name in words.items():
        fault = fault.replace(word, name)
    if fault.startswith("focal"):
        ahead = recording.velocity.mean(axis=0)
        ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
        setups = [replace(s, optical_axis=tuple(a.tolist())) for s, a in zip(recording.setups, ahead, strict=True)]
        recording = replace(recording, setups=tuple(setups))
    return variant_of(fault, "changed").applied(recording, seed)


@dataclass(frozen=True)
class Outcome:
    """Honest vehicles in the recordings of all seeds."""

    rmse: Array  # (seeds, vehicles), m
    anees: Array  # (seeds, vehicles)
    error: Array  # of all vehicle ticks, as the following ones, m
    deviation: Array  # stated, m
    horizontal: Array  # error, m
    level: Array  # horizontal protection level, m

    @property
    def mean(self) -> str:
        """Mean RMSE with its standard error over the seeds."""
        values = self.rmse.mean(axis=1)
        return in_parentheses(float(values.mean()), standard_error(values))

    @property
    def overconfident(self) -> str:
        """Share of the vehicle ticks, %."""
        return _percent((self.error > OVERCONFIDENT[0]) & (self.deviation < OVERCONFIDENT[1]))

    @property
    def exceeded(self) -> str:
        """Share of the vehicle ticks in which the error exceeds the protection level, %; `-` without levels."""
        return "-" if np.isnan(self.level).all() else _percent(self.horizontal > self.level)

    @property
    def levels(self) -> str:
        """Share exceeded, %, share unknown, %, and median of the known levels over the 95th percentile of the error."""
        known = np.isfinite(self.level)
        ratio = np.median(self.level[known]) / np.percentile(self.horizontal[known], 95) if known.any() else np.nan
        return f"{self.exceeded}, {_percent(~known)}, {ratio:.1f}"


def outcome(recordings: Mapping[int, Recording], fault: str, observer: str, since: float) -> Outcome:
    """Return what an observer makes of recordings, by seed, with a fault, from a time on."""
    found: dict[str, list[Array]] = {name: [] for name in Outcome.__dataclass_fields__}
    for seed, recording in recordings.items():
        part = changed(recording, fault, seed)
        result, when = run(observer, part), recording.t >= since
        false, lying = part.interference, np.zeros(len(recording.setups), bool)
        if false is not None:
            lying = (
                (false.shift != 0.0).any(axis=(0, 2)) | (false.turn != 0.0).any(axis=(0, 2)) | false.replay.any(axis=0)
            )
        shown = np.flatnonzero(~lying)
        error = result.position_error[when][:, shown]
        away = (result.position - recording.truth.position)[when][:, shown, :2]
        variance = np.trace(result.covariance[when][:, shown, 3:, 3:], axis1=-2, axis2=-1)
        found["rmse"].append(np.sqrt(np.square(error).mean(axis=0)))
        found["anees"].append(result.anees(since)[shown])
        found["error"].append(error.ravel())
        found["deviation"].append(np.sqrt(variance).ravel())
        found["horizontal"].append(np.linalg.norm(away, axis=-1).ravel())
        found["level"].append(result.protection_level[when][:, shown, 0].ravel())
    pooled = ("rmse", "anees")
    return Outcome(**{name: (np.stack if name in pooled else np.concatenate)(values) for name, values in found.items()})


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
                ratios = [(row.ratio_to_bound_ancestors, row.ratio_to_bound_ancestors_se) for row in own]
                cells.append(_both(ratios[len(ratios) // 2], ratios[-1]))
            own.sort(key=lambda row: row.anees)
            cells.append(_both(*((row.anees, row.anees_se) for row in (own[0], own[-1]))))
            rows.append([f"`{scene}`", f"`{observer}`", *cells])
            print(" | ".join(rows[-1]), file=sys.stderr, flush=True)
    return markdown(["scene", "observer", "5-10 s: median, worst", "after 35 s", "ANEES: least, largest"], rows)


def _both(first: tuple[float, float], second: tuple[float, float]) -> str:
    return f"{in_parentheses(*first)}, {in_parentheses(*second)}"


def undeclared(seeds: Sequence[int], jobs: int) -> str:
    """Return the table of errors that the scenario does not declare: mean RMSE, worst error, m, and largest ANEES."""
    rows, heads = {name: [name] for name in CHANGES}, ["error"]
    for scene, scenario in (("tracking", tracking()), ("road", road())):
        recordings = {seed: record(scenario, seed) for seed in seeds}
        heads += [f"{scene}: `{observer}`" for observer in CHANGED_OBSERVERS]
        for name, fault in CHANGES.items():
            for observer in CHANGED_OBSERVERS:
                found = outcome(recordings, fault, observer, JUDGED_FROM)
                anees = _compact(found.anees.mean(axis=0).max())
                rows[name].append(f"{found.mean}, {found.error.max():.2g} ({anees})")
            print(" | ".join(rows[name]), file=sys.stderr, flush=True)
    return markdown(heads, list(rows.values()))


def merged(seeds: Sequence[int], jobs: int) -> str:
    """Return the table of the merging platoons: mean and median RMSE, worst error, m; shares of vehicle ticks, %."""
    rows, recordings = [], {seed: record(merging(), seed) for seed in seeds}
    for name, fault in MERGING_CHANGES.items():
        cells = []
        for observer in CHANGED_OBSERVERS:
            found = outcome(recordings, fault, observer, MERGING_FROM)
            cells += [f"{found.mean}, {np.median(found.rmse):.2g}, {found.error.max():.2g}", found.overconfident]
        rows.append([name, *cells, found.exceeded])
        print(" | ".join(rows[-1]), file=sys.stderr, flush=True)
    heads = [head for observer in CHANGED_OBSERVERS for head in (f"`{observer}`", "overconfident")]
    return markdown(["error", *heads, "level exceeded"], rows)


def levels(seeds: Sequence[int], jobs: int) -> str:
    """Return the table of the protection levels of `robust`, see `Outcome.levels`."""
    rows = {name: [name] for name in LEVEL_CHANGES}
    for scenario in (tracking(), road(), merging()):
        recordings = {seed: record(scenario, seed) for seed in seeds}
        for name, fault in LEVEL_CHANGES.items():
            found = outcome(recordings, fault, "robust", FAULT_SHARE * scenario.horizon)
            rows[name].append(found.levels)
            print(" | ".join(rows[name]), file=sys.stderr, flush=True)
    return markdown(["error", "tracking", "road", "merging"], list(rows.values()))


MASK_SCENES, MASKS = ("lane:20", "tree:20", "random:20,seed=3"), (64, 8)
"""Scenes of 20 vehicles, and bits of the masks of `robust`: one for each vehicle, or shared by vehicles 8 apart."""


def masks(seeds: Sequence[int], jobs: int) -> str:
    """Return the table of shared bits in masks of vehicles: position RMSE (m) from 35 s on, over all vehicles."""
    rows = []
    for bits in MASKS:  # a process for each, because kernels are compiled with the number
        with ProcessPoolExecutor(1, get_context("spawn")) as pool:
            rows.append([str(bits), *pool.map(_masked, [(bits, scene, tuple(seeds)) for scene in MASK_SCENES])])
    return markdown(["bits", *MASK_SCENES], rows)


def _masked(given: tuple[int, str, Sequence[int]]) -> str:
    bits, scene, seeds = given
    constants.MASK_BITS = bits
    overrides = {"observer.name": "robust", "horizon": HORIZON}
    envs = coopenv.make_vec(scene, num_worlds=len(seeds), overrides=overrides, autoreset="disabled")
    envs.reset(seed=min(seeds))
    rate, errors = envs.scenario.rates.decision, []
    for step in range(1, round(HORIZON * rate)):
        envs.step(np.zeros(envs.action_space.shape, np.float32))
        if step >= WINDOWS[-1] * rate:
            errors.append(envs.engine.view("position_error").copy())
    mean = np.sqrt(np.mean(np.square(errors), axis=(0, 2)))  # by world
    return in_parentheses(float(mean.mean()), standard_error(mean))


def _percent(true: NDArray[np.bool_]) -> str:
    return f"{100.0 * true.mean():.2g}"


def _compact(value: float) -> str:
    return f"{value:.1f}" if value < 100.0 else f"{value:.0f}" if value < 1e5 else f"{value:.0e}"


PARTS: dict[str, Callable[[Sequence[int], int], str]] = {
    "scenes": scenes,
    "undeclared": undeclared,
    "merging": merged,
    "levels": levels,
    "masks": masks,
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; return the exit status: 0, or 2 after a mistake in the input."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.evidence", description=__doc__)
    parser.add_argument("what", choices=tuple(PARTS))
    parser.add_argument("--seeds", type=at_least(1), default=8, help="number of seeds (default: 8)")
    parser.add_argument("--first", type=at_least(0), default=50, help="the first seed (default: 50)")
    parser.add_argument("--jobs", type=at_least(1), default=1, help="number of processes (default: 1)")
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
