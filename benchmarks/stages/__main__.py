"""`python -m benchmarks.stages`: what a vehicle tick costs on one core, stage by stage."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from benchmarks.machine import machine
from benchmarks.options import at_least
from benchmarks.stages.ablated_stages import Setting, ablated_settings, stepper
from benchmarks.stages.against import HERE, Case, Side, compile_seconds
from benchmarks.stages.rounds import alternate, ratio
from coopenv.api.engine import Engine
from coopenv.base.errors import CoopenvError
from coopenv.cli.options import load, parse_overrides
from coopenv.report.table import Table
from coopenv.runs.console import Progress

SENSED = {"topology.mode": "sensed"}
RICCATI, ROBUST = {"observer.name": "riccati"}, {"observer.name": "robust"}
TOTALS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("busy_intersection", SENSED),
    ("urban_crossing", RICCATI),
    ("busy_intersection", SENSED | ROBUST),
    ("urban_crossing", ROBUST),
)
"""Environments and overrides whose whole ticks are measured."""
WARM_UP = 20
"""Decisions after a start that do not count: estimates settle, and with them the number of re-linearisations."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; return the exit status: 0, or 2 after a mistake in the input."""
    asked = parser().parse_args(arguments)
    out, log = Console(markup=False, highlight=False), Console(stderr=True)
    place = machine()
    try:
        overrides = parse_overrides(asked.set)
        out.print(
            f"ns of CPU time per vehicle tick, {asked.worlds} worlds, {asked.dtype}, one thread; medians of "
            f"{asked.rounds} alternating rounds of {asked.decisions} decisions. {place['processor']}, "
            f"{place['cores_available']} cores, load {place['load_average_at_start']:.1f}.\n"
        )
        out.print(whole_table(asked, overrides, log))
        out.print()
        if asked.against is None and not asked.lanes:
            out.print(stage_table(asked, SENSED | overrides, log))
        elif asked.against is not None and asked.compiles:
            out.print(compile_table(asked, log))
    except CoopenvError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    found = argparse.ArgumentParser(prog="python -m benchmarks.stages", description=__doc__)
    found.add_argument("environment", nargs="?", default="busy_intersection", metavar="ENV")
    found.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="override a scenario key")
    found.add_argument("--worlds", type=at_least(1), default=512)
    found.add_argument("--dtype", default="float32", choices=("float32", "float64"))
    found.add_argument("--rounds", type=at_least(1), default=9, help="of which the median counts (default: 9)")
    found.add_argument("--decisions", type=at_least(1), default=10, help="per round (default: 10)")
    found.add_argument("--against", type=Path, metavar="DIR", help="another checkout: whole ticks of both, in turn")
    found.add_argument(
        "--lanes", action="store_true", help="whole ticks without worlds in lanes and with them, in turn"
    )
    found.add_argument("--compiles", type=at_least(0), default=1, help="of each kind, from an empty cache (default: 1)")
    return found


def whole_table(asked: argparse.Namespace, extra: dict[str, Any], log: Console) -> Table:
    """Return the cost of steps of `make_vec` in some environments, of this checkout or of another one and this."""
    cases = [Case(name, asked.worlds, asked.dtype, {**overrides, **extra}) for name, overrides in TOTALS]
    other, this = "lanes off" if asked.lanes else "other", "lanes on" if asked.lanes else "this"
    compared = asked.against is not None or asked.lanes
    before = asked.against.resolve() if asked.against else HERE
    heads = [other, this, f"{this} / {other}", "middle half\nof rounds"] if compared else [this]
    table = Table.of_texts(["make_vec"], heads)
    with ExitStack() as stack:
        sides = [stack.enter_context(Side(before, cases, COOPENV_LANES="0"))] if compared else []
        sides.append(stack.enter_context(Side(HERE, cases, COOPENV_LANES=str(int(asked.lanes)))))
        with Progress(log, "building"):
            for side in sides:
                side.wait()
        with Progress(log, "measuring", total=len(cases)) as progress:
            for n, case in enumerate(cases):
                times = 1e9 * alternate([partial(side.step, n, asked.decisions) for side in sides], asked.rounds)
                cells = [f"{value:.0f}" for value in np.median(times, axis=0)]
                if compared:
                    share, low, high = ratio(times[:, 1], times[:, 0])
                    cells += [f"{share:.3f}", f"{low:.3f}..{high:.3f}"]
                table.add(case.name, *cells)
                progress.advance()
    return table


def stage_table(asked: argparse.Namespace, overrides: dict[str, Any], log: Console) -> Table:
    """Return what the tick of an environment costs with stages switched off, each on top of those before it."""
    ablated = list(ablated_settings())
    names = ["report and observation", *(name for name, _ in ablated)]
    with Progress(log, "building", total=len(names) + 1) as progress:
        engine = Engine(load(asked.environment, overrides), asked.worlds, asked.dtype, "cpu", 1)
        engine.reset(range(asked.worlds))
        steps = [stepper(engine.world, WARM_UP, lambda ticks: engine.step(ticks=ticks))]
        for name, setting in zip(names, (Setting(), *(setting for _, setting in ablated)), strict=True):
            progress.advance(f"building without {name}")
            world = setting.world(asked.environment, overrides, asked.worlds, asked.dtype)
            steps.append(stepper(world, WARM_UP))
    with Progress(log, "measuring"):
        times = 1e9 * alternate([partial(step, asked.decisions) for step in steps], asked.rounds)
    headings = ["cost\n[ns]", "middle half\nof rounds", "left with-\nout it [ns]"]
    table = Table.of_texts([f"stage ({asked.environment})"], headings)
    table.add("whole tick", "", "", f"{np.median(times[:, 0]):.0f}")
    for name, before, after in zip(names, times.T, times.T[1:], strict=False):
        low, high = np.quantile(before - after, (0.25, 0.75))
        table.add(name, f"{np.median(before - after):.0f}", f"{low:.0f}..{high:.0f}", f"{np.median(after):.0f}")
    return table


def compile_table(asked: argparse.Namespace, log: Console) -> Table:
    """Return the time of the first step with an empty kernel cache, of both checkouts, in turn."""
    kinds: list[tuple[str, dict[str, Any]]] = [("float32", {}), ("float64", {}), ("float32", ROBUST)]
    cases = [Case("busy_intersection", 1, dtype, overrides) for dtype, overrides in kinds]
    table = Table.of_texts(["first step, empty cache"], ["other [s]", "this [s]", "this / other"])
    with Progress(log, "compiling", total=len(cases)) as progress:
        for case in cases:
            sides = [partial(compile_seconds, checkout, case) for checkout in (asked.against.resolve(), HERE)]
            times = alternate(sides, asked.compiles)
            other, this = np.median(times, axis=0)
            table.add(f"{case.name}, {case.dtype}", f"{other:.1f}", f"{this:.1f}", f"{this / other:.2f}")
            progress.advance()
    return table


if __name__ == "__main__":
    sys.exit(main())
