"""Everything that was measured: printed for people, and written as `speed.json` and figures."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import Any

from rich.console import Console

from benchmarks.speed.cases import COOPENV
from benchmarks.speed.growth import Growth
from benchmarks.speed.measure import Result
from benchmarks.speed.startup import Startup
from benchmarks.speed.tables import growth_table, memory_table, ratio_table, ratios, speed_table, startup_table
from coopenv.base.files import replacing_file

JSON_FILE, SPEED_FILE, GROWTH_FILE = "speed.json", "speed.png", "growth.png"
FILES = (JSON_FILE, SPEED_FILE, GROWTH_FILE)
BUSY = 0.9
"""CPU time over wall time that a program on one thread has on a quiet machine, at least."""
LARGE = 1024
"""Worlds that are worth several threads."""


@dataclass
class Report:
    """Everything that was measured."""

    command: str
    """Command of the measurement."""
    environment: str
    seconds: float
    """Time per case and round."""
    rounds: int
    machine: dict[str, Any]
    versions: dict[str, str]
    results: list[Result]
    startup: Startup
    growth: list[Growth]

    def document(self) -> dict[str, Any]:
        """Return what `speed.json` holds."""
        return {
            "command": self.command,
            "environment": self.environment,
            "seconds_per_round": self.seconds,
            "rounds": self.rounds,
            "machine": self.machine,
            "versions": self.versions,
            "rows": [r.row() for r in self.results if not r.problem],
            "without_figures": [
                {"name": r.case.name, "worlds": r.case.worlds, "reason": r.problem} for r in self.results if r.problem
            ],
            "ratios": [asdict(ratio) for ratio in ratios(self.results)],
            "startup_s": asdict(self.startup),
            "growth": [g.row() for g in self.growth],
        }


def show(report: Report, out: Console) -> None:
    """Print the tables."""
    place = report.machine
    out.print(
        f"{report.environment} on {place['processor']}, {place['cores_available']} cores. Median of {report.rounds} "
        f"rounds of {report.seconds:g} s, alternating; a process per library, one busy at a time. Infos and resets "
        "are included, actions are drawn beforehand; peers run on one thread."
    )
    _section(out, "Rates")
    out.print(speed_table(report.results))
    for line in _counted(report.results):
        out.print(line)
    used = cores_used(report.results)
    out.print(f"Cores used: {', '.join(f'{cores:.2f} by cases on {n}' for n, cores in used.items())}.")
    if used.get(1, 1.0) < BUSY:
        out.print("Note: other programs held the processor during a part of the run; these figures are too low.")
    found = ratios(report.results)
    if found:
        _section(out, "coopenv (f32) over its peers, at the same number of worlds")
        out.print(ratio_table(found))
    _section(out, "Memory per world: arrays of the batch, and growth of the process")
    out.print(memory_table(report.results))
    _section(out, "Until the first step, in a fresh process")
    out.print(startup_table(report.startup))
    if not report.startup.compiling:
        out.print("Compiling is not measured by --quick.")
    if report.growth:
        _section(out, "Growth: CPU time of one step of all worlds, one thread, f32; cost ~ size ^ exponent")
        out.print(growth_table(report.growth))


def cores_used(results: list[Result]) -> dict[int, float]:
    """Return the median of CPU time over wall time by number of threads; on several threads large batches only."""
    groups: dict[int, list[float]] = {}
    for r in results:
        if not r.problem and (r.case.threads == 1 or r.case.worlds >= LARGE):
            groups.setdefault(r.case.threads, []).append(r.cores_used)
    return {threads: median(used) for threads, used in sorted(groups.items())}


def _section(out: Console, title: str) -> None:
    out.print(f"\n{title}\n")


def _counted(results: list[Result]) -> list[str]:
    """Say what stands in the column of vehicle ticks."""
    peers = [r.case for r in results if not r.problem and r.case.library != COOPENV.name]
    lines = ["Vehicle ticks: camera ticks of a vehicle (sensing and estimating, several per step)."]
    return lines + [f"  For {name}: {tick}." for name, tick in dict.fromkeys((c.name, c.tick) for c in peers)]


def write(report: Report, folder: Path) -> list[Path]:
    """Write `speed.json` and the figures, and return their paths.

    Raises:
        OutputError: a file cannot be written.
    """
    from benchmarks.speed.figures import draw_growth, draw_speed

    paths = [folder / JSON_FILE, folder / SPEED_FILE]
    with replacing_file(paths[0]) as new:
        new.write_text(json.dumps(report.document(), indent=2, default=str) + "\n", encoding="utf-8")
    draw_speed(report.results, paths[1])
    if report.growth:
        paths.append(draw_growth(report.growth, folder / GROWTH_FILE))
    return paths
