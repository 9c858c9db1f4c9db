"""`coopenv bench speed`: measure coopenv and its peers in one run, print tables, write pictures and figures."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

from rich.console import Console

from coopenv.bench import startup
from coopenv.bench.cases import COOPENV, Case, Library, own_cases
from coopenv.bench.fleet import Fleet
from coopenv.bench.growth import Growth, Sweep, summarise, sweeps
from coopenv.bench.machine import machine, versions
from coopenv.bench.measure import Result, measure, units_of_work
from coopenv.bench.peers import PEERS, install_hint, installed, peer_cases
from coopenv.bench.ratios import Ratio, ratios
from coopenv.bench.tables import growth_table, memory_table, ratio_table, speed_table, startup_table
from coopenv.errors import CoopenvError
from coopenv.runs.command import progress
from coopenv.runs.output import prepare_folder, writing
from coopenv.scenario import Scenario

JSON_FILE, SPEED_FILE, GROWTH_FILE = "speed.json", "speed.png", "growth.png"
BUSY = 0.9
"""CPU time over wall time that a program on one thread has on a quiet machine, at least."""
LARGE = 1024
"""Worlds that are worth several threads."""
IMPORTS = 3
"""Fresh processes per library, of whose import times the median counts."""


@dataclass(frozen=True)
class SpeedRequest:
    """What `coopenv bench speed` was asked for; see its help."""

    environment: str
    scenario: Scenario
    overrides: Mapping[str, Any] = field(default_factory=dict)
    seconds: float | None = None
    repeats: int | None = None
    out: Path | None = None
    growth: bool = False
    quick: bool = False
    peers: bool = True

    @property
    def window(self) -> float:
        """Time per case and round, s."""
        return self.seconds or (0.15 if self.quick else 0.5)

    @property
    def rounds(self) -> int:
        """Of which the median counts."""
        return self.repeats or (3 if self.quick else 5)

    @property
    def dtypes_to_compile(self) -> tuple[str, ...]:
        """Precisions whose kernels are compiled into an empty cache, which takes long."""
        return () if self.quick else ("float32", "float64")

    @property
    def command(self) -> str:
        """The command line that asks for the same, but for `--out`."""
        words = ["coopenv", "bench", "speed", self.environment]
        words += [f"--seconds {self.window:g}", f"--repeats {self.rounds}"]
        words += [f"--set {key}={json.dumps(value, default=str)}" for key, value in self.overrides.items()]
        flags = {"--growth": self.growth, "--quick": self.quick, "--no-peers": not self.peers}
        return " ".join([*words, *(flag for flag, on in flags.items() if on)])


@dataclass
class Report:
    """Everything that was measured."""

    request: SpeedRequest
    machine: dict[str, Any]
    versions: dict[str, str]
    results: list[Result]
    startup: startup.Startup
    growth: list[Growth]

    @property
    def ratios(self) -> list[Ratio]:
        """The rates of coopenv over those of its peers."""
        return ratios(self.results)

    def document(self) -> dict[str, Any]:
        """Return what `speed.json` holds."""
        return {
            "command": self.request.command,
            "environment": self.request.environment,
            "seconds_per_round": self.request.window,
            "rounds": self.request.rounds,
            "machine": self.machine,
            "versions": self.versions,
            "rows": [r.row() for r in self.results if not r.problem],
            "without_figures": [
                {"name": r.case.name, "worlds": r.case.worlds, "reason": r.problem} for r in self.results if r.problem
            ],
            "ratios": [r.row() for r in self.ratios],
            "startup_s": asdict(self.startup),
            "growth": [g.row() for g in self.growth],
        }


def execute(request: SpeedRequest, out: Console, log: Console) -> Report:
    """Measure, print and write.

    Raises:
        CoopenvError: coopenv itself cannot be stepped, or the results cannot be written.
    """
    if request.out is not None:
        prepare_folder(request.out)
        for name in (JSON_FILE, SPEED_FILE, GROWTH_FILE):
            if (request.out / name).is_dir():
                raise CoopenvError(f"cannot write to {request.out / name}: it is a folder")
    report = run(request, log)
    show(report, out)
    if request.out is not None:
        files = write(report, request.out)
        out.print(f"Files in {request.out}: {', '.join(path.name for path in files)}", soft_wrap=True)
    return report


def run(request: SpeedRequest, log: Console) -> Report:
    """Measure everything, one process busy at a time."""
    place = machine()
    peers = [peer for peer in PEERS if request.peers and installed(peer)]
    libraries: list[Library] = [COOPENV, *peers]
    names = {library.name for library in libraries}
    cases = own_cases(request.environment, request.scenario, request.overrides, request.quick)
    wanted = peer_cases(request.quick) if request.peers else []
    cases += [case for case in wanted if case.library in names]
    grown = [(sweep, sweep.cases()) for sweep in sweeps(request.quick)] if request.growth else []
    growth_cases = [case for _, found in grown for case in found]
    imports = 1 if request.quick else IMPORTS
    total = units_of_work(cases, request.rounds) + units_of_work(growth_cases, request.rounds)
    total += startup.units_of_work(libraries, request.dtypes_to_compile, imports)
    with progress(log) as bar:
        task = bar.add_task("starting", total=total)

        def on_progress(text: str) -> None:
            bar.update(task, description=text, advance=1)

        waits = startup.measure_startup(
            libraries, request.environment, dict(request.overrides), request.dtypes_to_compile, imports, on_progress
        )
        with Fleet(libraries) as fleet:
            results = measure(cases, fleet, request.window, request.rounds, on_progress)
        with Fleet(libraries) as fleet:  # with the memory of the first one free again
            growth = measure(growth_cases, fleet, request.window, request.rounds, on_progress)
    for result in (r for r in results if r.problem and r.case.library == COOPENV.name):
        raise CoopenvError(f"{result.case.name}, {result.case.worlds} worlds: {result.problem}")
    results += [Result(case, problem=_missing(case)) for case in wanted if case.library not in names]
    return Report(request, place, versions(peers), results, waits, _growth(grown, growth))


def _missing(case: Case) -> str:
    return next(install_hint(peer) for peer in PEERS if peer.name == case.library)


def _growth(grown: list[tuple[Sweep, list[Case]]], results: list[Result]) -> list[Growth]:
    found, start = [], 0
    for sweep, cases in grown:
        growth = summarise(sweep, results[start : start + len(cases)])
        start += len(cases)
        if growth is not None:
            found.append(growth)
    return found


def show(report: Report, out: Console) -> None:
    """Print the tables."""
    request, place = report.request, report.machine
    out.print(
        f"{request.environment} on {place['processor']}, {place['cores_available']} cores. Median of {request.rounds} "
        f"rounds of {request.window:g} s, alternating; a process per library, one busy at a time. Resets are "
        "included, actions are drawn beforehand; peers run on one thread."
    )
    _section(out, "Rates; infos cost: of the rate without infos")
    out.print(speed_table(report.results))
    for line in _counted(report.results):
        out.print(line)
    used = cores_used(report.results)
    out.print(f"Cores used: {', '.join(f'{cores:.2f} by cases on {n}' for n, cores in used.items())}.")
    if used.get(1, 1.0) < BUSY:
        out.print("Note: other programs held the processor during a part of the run; these figures are too low.")
    found = report.ratios
    if found:
        _section(out, "coopenv (f32, infos included) over its peers, at the same number of worlds")
        out.print(ratio_table(found))
    _section(out, "Memory per world: arrays of the batch, and growth of the process")
    out.print(memory_table(report.results))
    _section(out, "Until the first step, in a fresh process")
    out.print(startup_table(report.startup))
    if not report.startup.compiling:
        out.print("Compiling is not measured by --quick.")
    if report.growth:
        _section(out, "Growth: time of one step of all worlds, one thread, f32; cost ~ size ^ exponent")
        out.print(growth_table(report.growth))


def cores_used(results: list[Result]) -> dict[int, float]:
    """Return the median of CPU time over wall time by number of threads; on several threads large batches only."""
    groups: dict[int, list[float]] = {}
    for r in results:
        if not r.problem and (r.case.threads == 1 or r.case.worlds >= LARGE):
            groups.setdefault(r.case.threads, []).append(r.cores_used)
    return {threads: median(used) for threads, used in sorted(groups.items())}


def _section(out: Console, title: str) -> None:
    out.print()
    out.print(title)
    out.print()


def _counted(results: list[Result]) -> list[str]:
    """Say what stands in the column of vehicle ticks."""
    counted = dict.fromkeys(
        (r.case.name, r.case.tick) for r in results if not r.problem and r.case.library != "coopenv"
    )
    lines = ["Vehicle ticks: camera ticks of a vehicle (sensing and estimating, several per step)."]
    return lines + [f"  For {name}: {tick}." for name, tick in counted]


def write(report: Report, folder: Path) -> list[Path]:
    """Write `speed.json` and the pictures, and return their paths.

    Raises:
        OutputError: a file cannot be written.
    """
    from coopenv.bench.picture import draw_growth, draw_speed

    paths = [folder / JSON_FILE, folder / SPEED_FILE]
    with writing(paths[0]):
        paths[0].write_text(json.dumps(report.document(), indent=2, default=str) + "\n", encoding="utf-8")
    with writing(paths[1]):
        draw_speed(report.results, paths[1])
    if report.growth:
        paths.append(folder / GROWTH_FILE)
        with writing(paths[-1]):
            draw_growth(report.growth, paths[-1])
    return paths
