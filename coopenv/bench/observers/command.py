"""`coopenv bench observers`: from what the user asked for to tables and files."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from rich.console import Console
from rich.table import Table

from coopenv.bench.observers import files
from coopenv.bench.observers.basin import (
    Basin,
    Draw,
    basin_failures,
    basins_of,
    check_source,
    plain_draws,
    study_basin,
)
from coopenv.bench.observers.compare import Outcome, compare
from coopenv.bench.observers.executors import Engine
from coopenv.bench.observers.faults import FAULTS, NOMINAL
from coopenv.bench.observers.rows import Row
from coopenv.bench.observers.sources import ALL, Source, find_source, variants_of
from coopenv.bench.observers.tables import (
    degradation_table,
    error_table,
    failures,
    honest_line,
    quality_table,
    variant_table,
)
from coopenv.bench.tables import number_table
from coopenv.estimation.metrics import json_ready
from coopenv.files import replacing_folder
from coopenv.observers.registry import available_names, find, observer_names, obstacle
from coopenv.runs.console import Progress

T = TypeVar("T")


@dataclass(frozen=True)
class Found:
    """What a comparison has found."""

    outcome: Outcome
    draws: list[Draw]
    basins: list[Basin]


@dataclass(frozen=True)
class Request:
    """What is to be compared."""

    source: Source
    source_text: str
    """As the user named it."""
    observers: tuple[str, ...]
    variants: tuple[str, ...]
    seeds: int
    steady_from: float | None = None
    basin: int = 0
    """Draws of initial estimates; 0: no study of basins."""
    options: tuple[str, ...] = ()
    """Further options that the result depends on."""
    left_out: Mapping[str, str] = field(default_factory=dict)
    """Observers and variants that would have been compared, but for a reason that is told."""

    @property
    def command(self) -> str:
        """The command that gives the same table again."""
        words = ["coopenv", "bench", "observers", self.source_text, "--observers", ",".join(self.observers)]
        words += ["--variants", ",".join(self.variants), "--seeds", str(self.seeds)]
        words += [] if self.steady_from is None else ["--steady-from", f"{self.steady_from:g}"]
        words += ["--basin", str(self.basin)] if self.basin else []
        return shlex.join([*words, *self.options])


def request_of(
    text: str,
    observers: str | None,
    variants: str | None,
    seeds: int,
    steady_from: float | None,
    basin: int,
    data: Path | None,
    overrides: Mapping[str, Any],
    assignments: Sequence[str],
) -> Request:
    """Return the request behind the options of the command line.

    Args:
        text: environment, dataset or log file.
        observers: names with commas between; None: all that are meant for such vehicles.
        variants: the same, or `all`; None: the usual ones of the source.
        seeds: how many.
        steady_from: s; None: the source's own.
        basin: draws.
        data: folder of recorded data.
        overrides: of the scenario.
        assignments: the same, as they were written.

    Raises:
        CoopenvError: something of it does not exist.
    """
    source = find_source(text, overrides, data)
    names = names_of(observers) if observers else tuple(available_names(source.planar))
    for name in names:
        find(name)
    left_out = {} if observers else {name: obstacle(name) for name in observer_names()}
    if basin:
        check_source(source)
    options = [word for assignment in assignments for word in ("--set", assignment)]
    options += [] if data is None else ["--data", str(data)]
    wanted = variants_of(source, variants)
    if variants is not None and variants.strip() == ALL:
        left_out |= {name: source.obstacle(name) for name in source.variants}
    told = {name: reason for name, reason in left_out.items() if reason}
    return Request(source, text, names, wanted, seeds, steady_from, basin, tuple(options), told)


def names_of(text: str) -> tuple[str, ...]:
    """Return names with commas between, each once."""
    return tuple(dict.fromkeys(name.strip() for name in text.split(",")))


def perform(request: Request, engine: Engine, out: Path | None, printed: Console, log: Console) -> None:
    """Compare, print the tables and write the files.

    Args:
        request: what is to be compared.
        engine: where the work is done.
        out: folder for the files; None: no files.
        printed: for the tables.
        log: for the progress.

    Raises:
        CoopenvError: something that was asked for does not exist, or cannot be written.
    """
    found = None
    try:
        with nullcontext() if out is None else replacing_folder(out, (*files.FILES, files.BASIN_FILE)) as folder:
            found = _compare(request, engine, log)
            if folder is not None:
                write_files(request, found, folder)
                names = sorted(path.name for path in folder.iterdir())
    finally:  # hours of work are told even if they cannot be written
        if found is not None:
            print_tables(found.outcome.rows, found.basins, printed)
    if out is not None:
        printed.print(f"Files in {out}: {', '.join(names)}", soft_wrap=True)


def _compare(request: Request, engine: Engine, log: Console) -> Found:
    for name, reason in request.left_out.items():
        log.print(f"left out: {name} ({reason})", soft_wrap=True, markup=False)
    outcome = _with_progress(
        log,
        f"{len(request.observers)} observers, {len(request.variants)} variants, {request.seeds} seeds",
        lambda update: compare(
            request.source,
            request.observers,
            request.seeds,
            request.variants,
            request.steady_from,
            engine,
            update,
        ),
    )
    draws: list[Draw] = []
    if request.basin:
        draws = _with_progress(
            log,
            f"{len(request.observers)} observers, {request.basin} initial estimates",
            lambda update: study_basin(request.source, request.observers, request.basin, engine, update),
        )
    return Found(outcome, draws, basins_of(request.source.name, draws))


def print_tables(rows: Sequence[Row], basins: Sequence[Basin], printed: Console) -> None:
    """Print errors and quality, faults as one table, basins, and who failed."""
    variants = list(dict.fromkeys(row.variant for row in rows))
    in_full = variants[:1] if all(name in FAULTS for name in variants) else variants
    for variant in in_full:
        own = [row for row in rows if row.variant == variant]
        printed.print(f"\n{own[0].environment}, {variant}")
        printed.print(error_table(own))
        printed.print()
        printed.print(quality_table(own))
        if line := honest_line(own):
            printed.print(line, soft_wrap=True)
    if len(variants) > 1:
        printed.print()
        printed.print(variant_table(rows))
        if NOMINAL in variants:
            printed.print()
            printed.print(degradation_table(rows))
    if basins:
        printed.print()
        printed.print(_basin_table(basins))
    for line in (*failures(rows), *basin_failures(basins)):
        printed.print(line, soft_wrap=True)


def _basin_table(basins: Sequence[Basin]) -> Table:
    table = number_table(
        ["basin"], ["draws", "failed", "all vehicles\nconverge", "95 %", "converged [s]\nmedian"], gap=0
    )
    for basin in basins:
        low, high = (100 * end for end in basin.interval)
        last = basin.convergence_time_s
        table.add_row(
            basin.observer,
            str(basin.draws),
            str(basin.failed),
            f"{100 * basin.converged_fraction:.1f} %",
            f"{low:.1f}..{high:.1f} %",
            f"{last:.1f}" if last == last else "-",
        )
    return table


def write_files(request: Request, found: Found, out: Path) -> None:
    """Write the leaderboard as JSON and CSV, the draws as CSV, and the report.

    Raises:
        OutputError: a file cannot be written.
    """
    from coopenv.bench.observers.report import Report, write_report

    outcome, draws, basins = found.outcome, found.draws, found.basins
    more = {"basin": [asdict(basin) for basin in basins]} if basins else {}
    seeds = request.seeds if request.source.seeded else 1
    content = files.document(outcome.rows, request.command, seeds, **more)
    files.write_json(content, out / files.JSON_FILE)
    files.write_rows(outcome.rows, out / files.CSV_FILE)
    if draws:
        table = json_ready(plain_draws(draws))
        files.write_csv(table, list(table[0]), out / files.BASIN_FILE)
    title = f"Observers in {request.source.name}"
    report = Report(title, content, outcome.rows, outcome.samples, request.source.variants, draws, basins)
    write_report(report, out / files.REPORT_FILE)


def _with_progress(log: Console, description: str, work: Callable[[Callable[[float], None]], T]) -> T:
    with Progress(log, description, total=1.0) as progress:
        return work(progress.update)
