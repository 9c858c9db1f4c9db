"""`python -m benchmarks.receipt`: what each part of `robust` buys, and how much its numbers matter.

Without arguments it leaves out one part after the other, and all monitors together; then follow other observers, which
have no monitors. Columns of the table in Markdown:
false exclusions per hour of a vehicle in worlds without a fault; median time from a lie to the exclusion of its sender;
median CPU time of an update, us; mean position RMSE of honest vehicles by case, m. With `--without` it leaves out the
given parts, or several together, as in `--without "readmission + prior"`, or measures the given observers. With
`--constants` it halves and doubles each constant that follows from no other one; those that follow from it change with
it. Every variant runs in a process of its own, in which functions or constants are replaced before compilation, which
takes half a minute per variant, once per machine.
"""

from __future__ import annotations

import argparse
import ast
import inspect
import json
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from time import process_time
from typing import Any

import numpy as np
from rich.console import Console

from benchmarks.options import at_least
from coopenv.base.errors import CoopenvError, check_one_of
from coopenv.base.format import in_parentheses
from coopenv.report.table import markdown
from coopenv.runs.console import Progress

AT = 12.0
"""s, from when on there is a fault, but for some of the map and of the scale."""
CASES = ("nominal", "landmark", "bias", "camera", "random")
"""In both scenes: busy_intersection_tracking, and the road of `benchmarks.evidence`."""
LIES = {
    "jump": f"vehicle_2:lie=jump:1@{AT:g}",
    "drift": f"vehicle_2:lie=drift:0.2@{AT:g},honest_odometry=1",
    "collusion": f"vehicle_1,vehicle_2:lie=collude:1@{AT:g}",
}
"""See `--fault` of `coopenv bench observers`."""
TRACKING_CASES = (*CASES, "passing", "large bias", "scale", "swapped", *LIES)
ROAD_CASES = (*CASES, "focal length", "prior")
"""In the first scene; passing: a landmark that is wrong for 4 s. In the second one: `ROAD_CASES`."""

RIVALS = ("schmidt_kalman_individual", "schmidt_kalman", "self_calibrating")
"""Observers beside `robust`: a gate of each measurement, a joint gate, and lasting errors as states."""


def parts() -> dict[str, list[tuple[Any, str, Any]]]:
    """Return what leaves out each part of the observer: attributes of modules, and what replaces them."""
    import warp as wp

    from coopenv.observers.robust import (
        constants,
        correction,
        correlated_fusion,
        fault_hypotheses,
        integrity,
        measurements,
        observer,
    )
    from coopenv.observers.robust.integrity import end_block, own_fault_variance
    from coopenv.observers.robust.memory import SENDER_SLOTS
    from coopenv.observers.robust.sources import FOCAL, PRIOR, take_slot
    from coopenv.world.warp_internals import device_function

    def without(source: int) -> Any:
        @device_function
        def variance(memory: Any, world: int, i: int, q: int):  # type: ignore[no-untyped-def]
            return wp.where(q == source, wp.float64(0.0), own_fault_variance(memory, world, i, q))

        return variance

    @device_function
    def no_landmark(memory: Any, world: int, i: int, target: int, tick: int, landmark: bool, period: Any):  # type: ignore[no-untyped-def]
        if landmark:
            return -1
        return take_slot(memory, world, i, target, tick, landmark, period)

    @device_function
    def no_offsets(memory: Any, world: int, i: int, time: Any):  # type: ignore[no-untyped-def]
        end_block(memory, world, i, time)
        for q in range(1, 1 + SENDER_SLOTS):
            memory.source[world, i, q].ratio = wp.float64(0.0)

    @device_function
    def no_drift(memory: Any, world: int, i: int, landmarks: int) -> bool:
        return False

    @device_function
    def no_mixture(memory: Any, world: int, i: int, most: Any, total: Any):  # type: ignore[no-untyped-def]
        pass

    @device_function
    def no_readmission(frame: Any, memory: Any, world: int, i: int, n: int, q: int):  # type: ignore[no-untyped-def]
        pass

    @device_function
    def no_increment(memory: Any, world: int, i: int, n: int, d: Any):  # type: ignore[no-untyped-def]
        pass

    @device_function
    def no_joint_gate(memory: Any, world: int, i: int, bearings: int):  # type: ignore[no-untyped-def]
        correction.correct_by_bearings(memory, world, i, bearings, False)

    return {
        "nothing": [],
        "joint gate of bearings": [(correction, "gate_jointly", no_joint_gate)],
        "prior": [(integrity, "own_fault_variance", without(PRIOR))],
        "focal length": [(integrity, "own_fault_variance", without(FOCAL))],
        "all monitors": [(constants, "FAULT_GATE", 1e30)],
        "monitors of the own sensors": [(constants, "OWN_FAULT", 1e-9)],
        "monitors of landmarks": [(measurements, "take_slot", no_landmark)],
        "senders' offsets": [(fault_hypotheses, "end_block", no_offsets)],
        "senders' drifts": [(fault_hypotheses, "exclude_drifting", no_drift)],
        "covariance of likely faults": [(fault_hypotheses, "set_fault_mixture", no_mixture)],
        "readmission": [(observer, "test_excluded", no_readmission)],
        "restarts when lost": [(constants, "LOST_SHARE", 2.0)],
        "gyro bias": [(constants, "GYRO_BIAS", 1e-6), (constants, "GYRO_BIAS_WALK", 1e-6)],
        "senders' increments": [(correlated_fusion, "apply_sender_increment", no_increment)],
        "linearisation variance": [(constants, "CONSIDERED_LINEARISATION_TIME", 0.0)],
    }


def numbers() -> list[str]:
    """Return the names of the observer's numbers that follow from no other one, without counts."""
    from coopenv.observers.robust import constants

    own = [name for statement, names in statements() if not _names(statement.value) for name in names]
    return [name for name in own if isinstance(getattr(constants, name), float)]


def statements() -> list[tuple[ast.Assign, list[str]]]:
    """Return the assignments of the module of constants, each with the names that it defines."""
    from coopenv.observers.robust import constants

    assigned = [node for node in ast.parse(inspect.getsource(constants)).body if isinstance(node, ast.Assign)]
    return [(node, [name for target in node.targets for name in _names(target)]) for node in assigned]


def _names(expression: ast.expr) -> list[str]:
    """Return the names of constants in an expression."""
    return [node.id for node in ast.walk(expression) if isinstance(node, ast.Name) and node.id.isupper()]


def set_constants(values: Mapping[str, float]) -> None:
    """Set constants, and evaluate again all that follow from them."""
    from coopenv.observers.robust import constants

    for statement, names in statements():
        exec(compile(ast.Module([statement], []), constants.__file__, "exec"), vars(constants))
        vars(constants).update({name: values[name] for name in names if name in values})


def changes_of(variant: str) -> list[tuple[Any, str, Any]]:
    """Return what a variant replaces, see `leave_out`.

    Raises:
        CoopenvError: there is no such part, or two replace the same function or number.
    """
    from coopenv.observers.robust import constants

    name, _, factor = variant.partition("*")
    if factor and name in numbers():
        return [(constants, name, getattr(constants, name) * float(factor))]
    known, changes = parts(), []
    for part in map(str.strip, variant.split("+")):
        check_one_of("unknown part", part, known)
        changes += known[part]
    if len({(module.__name__, name) for module, name, _ in changes}) < len(changes):
        raise CoopenvError(f"parts that replace the same function or number cannot be left out together: {variant!r}")
    return changes


def leave_out(variant: str) -> None:
    """Replace what parts consist of, or multiply a constant, before anything is compiled: PART + PART, or NAME*FACTOR.

    Raises:
        CoopenvError: see `changes_of`.
    """
    from coopenv.observers.robust import constants

    changes = changes_of(variant)
    set_constants({name: value for module, name, value in changes if module is constants})
    for module, name, value in changes:
        setattr(module, name, value)


def measure(variant: str, seeds: Sequence[int]) -> dict[str, Any]:
    """Return the values by case of every seed, with a part left out or a constant changed, or of another observer."""
    if variant not in RIVALS:
        leave_out(variant)
    from benchmarks import evidence
    from coopenv.observers.registry import find
    from coopenv.runs import record

    factory = find(variant if variant in RIVALS else "robust")
    found: dict[str, Any] = {"exclusions": 0.0, "hours": 0.0, "delay": [], "microseconds": [], "rmse": {}}
    for scene, made in (("tracking", evidence.tracking()), ("road", evidence.road())):
        for seed in seeds:
            recording = record(made, seed)
            for case in TRACKING_CASES if scene == "tracking" else ROAD_CASES:
                add_case(found, scene, case, recording, seed, factory)
    return found


def add_case(found: dict[str, Any], scene: str, case: str, recording: Any, seed: int, factory: Any) -> None:
    """Run the observers on a changed recording, and add what they show to the values found."""
    from benchmarks import evidence
    from coopenv.observers import run

    names = [setup.name for setup in recording.setups]
    watched = [Watched(factory(setup), setup) for setup in recording.setups]
    changed = change_of(case)(recording, seed)
    result = run(lambda setup: watched[names.index(setup.name)], changed)
    if result.failure:
        raise RuntimeError(result.failure)
    found["microseconds"].append(1e6 * float(np.median([w.seconds for w in watched])))
    liars = [n for n, name in enumerate(names) if name in LIES.get(case, "")]
    errors = np.delete(result.position_rmse(evidence.JUDGED_FROM), liars)
    found["rmse"].setdefault(f"{scene}: {case}", []).append(float(errors.mean()))
    if case == "nominal":
        found["exclusions"] += sum(len(observer.times) for observer in watched)
        found["hours"] += len(names) * float(recording.t[-1]) / 3600.0
    for liar in liars:
        target = len(recording.landmarks[0]) + liar
        first = [next((t for t, q in w.times if q == target), np.inf) for w in watched]
        found["delay"] += [t - AT for w, t in zip(watched, first, strict=True) if w.sees(target)]


def change_of(case: str) -> Callable[..., Any]:
    """Return what changes a recording as in a case; its arguments are the recording and a seed."""
    from benchmarks.evidence import CHANGES, STEP_AT, changed

    faults = {
        "nominal": "",
        "landmark": CHANGES["one landmark off by 3 m"],
        "bias": f"gyro_step={np.radians(1.0)}@{STEP_AT}",
        "camera": f"vehicle_2:camera_step={np.radians(3.0)}@{STEP_AT}",
        "large bias": f"gyro_step={np.radians(5.0)}@{STEP_AT}",
        "scale": "scale_drift=0.1",
        "random": "random_bearings=0.1",
        "swapped": CHANGES["5 % of the bearings swapped"],
        "focal length": CHANGES["focal length 5 % too large"],
        "prior": CHANGES["initial estimates off by 3 m"],
        **LIES,
    }
    return passing if case == "passing" else lambda recording, seed: changed(recording, faults[case], seed)


def passing(recording: Any, seed: int) -> Any:
    """Return a recording in which the second landmark of the maps is 3 m off from `AT` on for 4 s."""
    landmarks = recording.landmarks.copy()
    landmarks[(recording.t >= AT) & (recording.t < AT + 4.0), 1] += (1.8, 2.4, 0.0)
    return replace(recording, landmarks=landmarks)


class Watched:
    """An observer of which the times of exclusions are noted, if it has monitors."""

    def __init__(self, observer: Any, setup: Any) -> None:
        self.observer, self.targets = observer, setup.targets
        self._known = self._exclusions()
        self.times: list[tuple[float, int]] = []
        self.seconds: list[float] = []  # CPU time of each update

    def __getattr__(self, name: str) -> Any:
        return getattr(self.observer, name)

    def sees(self, target: int) -> bool:
        """Return whether a target is a neighbour of the vehicle."""
        return target in self.targets

    def _exclusions(self) -> np.ndarray:
        memory = getattr(self.observer, "memory", None)
        return np.zeros(0, int) if memory is None else memory.source["exclusions"].copy()

    def update(self, tick: Any) -> Any:
        """Take a tick, and note what has been excluded."""
        begin = process_time()
        estimate = self.observer.update(tick)
        self.seconds.append(process_time() - begin)
        exclusions = self._exclusions()
        for q in np.flatnonzero(exclusions > self._known):
            self.times.append((float(tick.time), int(self.observer.memory.source["target"][q])))
        self._known = exclusions
        return estimate


def part_table(results: dict[str, dict[str, Any]]) -> str:
    """Return the table, in Markdown, of the parts that are left out."""
    rows = []
    for part, found in results.items():
        delay = float(np.median(found["delay"]))
        rate = found["exclusions"] / found["hours"]
        times = [
            f"{rate:.1f}",
            f"{delay:.1f}" if np.isfinite(delay) else "-",
            f"{np.median(found['microseconds']):.0f}",
        ]
        rows.append([part, *times, *map(_mean, found["rmse"].values())])
    heads = [
        "left out",
        "false exclusions, 1/h",
        "time to exclude, s",
        "CPU per update, us",
        *results["nothing"]["rmse"],
    ]
    return markdown(heads, rows)


def constant_table(results: dict[str, dict[str, Any]]) -> str:
    """Return the table of the numbers: ratio of the RMSE to that with all as they are, nominal and over the faults."""
    base, rows = results["nothing"]["rmse"], []
    faults = [case for case in base if not case.endswith(": nominal")]
    nominal = [case for case in base if case not in faults]
    for variant, found in results.items():
        rmse = found["rmse"]
        worst = max(faults, key=lambda case: np.mean(rmse[case]) / np.mean(base[case]))
        cells = [_ratio(rmse, base, cases) for cases in (nominal, faults, [worst])]
        rows.append([variant, *cells, worst, f"{found['exclusions'] / found['hours']:.1f}"])
    return markdown(["number", "without fault", "faults, mean", "worst fault", "which", "false exclusions, 1/h"], rows)


def _ratio(rmse: Mapping[str, Any], base: Mapping[str, Any], cases: Sequence[str]) -> str:
    """Return the mean over the cases of the ratio of mean RMSE, with its standard error over the seeds (jackknife)."""
    pairs = np.array([[rmse[case], base[case]] for case in cases])  # cases, 2, seeds
    count = pairs.shape[-1]

    def ratio(kept: np.ndarray) -> float:
        means = kept.mean(axis=-1)
        return float(np.mean(means[:, 0] / means[:, 1]))

    if count == 1:
        return in_parentheses(ratio(pairs), np.nan)
    others = [ratio(np.delete(pairs, seed, axis=-1)) for seed in range(count)]
    return in_parentheses(ratio(pairs), float(np.sqrt(count - 1) * np.std(others)))


def _mean(values: Sequence[float]) -> str:
    spread = float(np.std(values, ddof=1) / np.sqrt(len(values))) if len(values) > 1 else np.nan
    return in_parentheses(float(np.mean(values)), spread)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure every variant in a process of its own and print the table; return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.receipt", description=__doc__)
    parser.add_argument("--seeds", type=at_least(1), default=8, help="number of seeds (default: 8)")
    parser.add_argument("--first", type=at_least(0), default=7000, help="the first seed (default: 7000)")
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--without", nargs="+", metavar="PART", help="parts, or several as in 'PART + PART'")
    what.add_argument("--constants", nargs="*", metavar="NAME", help="names of constants; none: all")
    what.add_argument("--variant", help=argparse.SUPPRESS)
    asked = parser.parse_args(arguments)
    seeds = range(asked.first, asked.first + asked.seeds)
    if asked.variant:
        print(json.dumps(measure(asked.variant, seeds)))
        return 0
    variants = ["nothing", *asked.without] if asked.without else [*parts(), *RIVALS]
    try:
        for variant in (name for name in variants if name not in RIVALS):
            changes_of(variant)
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    if asked.constants is not None:
        unknown = sorted(set(asked.constants) - set(numbers()))
        if unknown:
            print(f"error: unknown constants {', '.join(unknown)}; known: {', '.join(numbers())}", file=sys.stderr)
            return 2
        variants = ["nothing", *(f"{name}*{by:g}" for name in asked.constants or numbers() for by in (0.5, 2.0))]
    results = {}
    with Progress(Console(stderr=True), "measuring variants", total=len(variants)) as progress:
        for done, variant in enumerate(variants):
            progress.update(done)
            options = ["--seeds", str(asked.seeds), "--first", str(asked.first), "--variant", variant]
            command = [sys.executable, "-m", "benchmarks.receipt", *options]
            result = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
            results[variant] = json.loads(result.stdout.splitlines()[-1])
    print(part_table(results) if asked.constants is None else constant_table(results))
    print(f"\n{asked.seeds} seeds from {asked.first} on.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
