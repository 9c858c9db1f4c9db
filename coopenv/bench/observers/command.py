"""`coopenv bench observers`: from what the user asked for to tables and files."""

import re
import shlex
import sys
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console

from coopenv.base.errors import CoopenvError
from coopenv.base.files import replace_text, replacing_folder
from coopenv.base.format import json_text, jsonable
from coopenv.base.installation import versions
from coopenv.bench.executors import Executor
from coopenv.bench.observers.basin import Basin, Draw, basin_failures, basin_table, basins_of, check_source, study_basin
from coopenv.bench.observers.choice import ALL, find_source
from coopenv.bench.observers.comparison import Comparison, Plan
from coopenv.bench.observers.tables import csv_text
from coopenv.observers.registry import observer_names, obstacle
from coopenv.runs.console import Progress
from coopenv.viz import FORMATS

JSON_FILE, CSV_FILE, REPORT_FILE, BASIN_FILE = "leaderboard.json", "leaderboard.csv", "report.html", "basin.csv"
WINDOWS_FILE, LATEX_FILE = "windows.csv", "leaderboard.tex"


class Request(NamedTuple):
    """What the command line asks for."""

    plan: Plan
    command: str
    """The one that gives the same table again."""
    basin: int
    """Draws of initial estimates; 0: no study of basins."""
    left_out: Mapping[str, str]
    """Observers and variants that would have been compared, but for a reason that is told."""


def request_of(
    text: str,
    observers: str | None,
    variants: str | None,
    seeds: range,
    steady_from: float | None,
    basin: int,
    data: Path | None,
    overrides: Mapping[str, Any],
    assignments: Sequence[str],
    topics: Path | None = None,
    faults: Sequence[str] = (),
    policy: str | None = None,
    windows: str | None = None,
) -> Request:
    """Return the request behind the options of the command line, `overrides` being `assignments` as they are read.

    Raises:
        CoopenvError: something of it does not exist.
    """
    source = find_source(text, overrides, data, topics, faults, policy)
    given = list(dict.fromkeys(word.strip() for word in observers.split(","))) if observers else None
    plan = Plan.of(source, given, variants, seeds, steady_from, windows)
    if basin:
        check_source(source)
    left_out = {} if observers else {name: obstacle(name) for name in observer_names()}
    if variants is not None and variants.strip() == ALL:
        left_out |= {name: source.obstacle(name) for name in source.variants}
    words = ["coopenv", "bench", "observers", text, "--observers", ",".join(given or plan.observers)]
    added = {variant.name for variant in source.added}
    words += ["--variants", ",".join(name for name in plan.variants if name not in added), "--seeds", str(len(seeds))]
    words += [word for name in plan.variants if name in added for word in ("--fault", name)]
    words += [] if policy is None else ["--policy", policy]
    words += ["--first", str(seeds[0])] if seeds[0] else []
    words += [] if steady_from is None else ["--steady-from", f"{steady_from:g}"]
    words += [] if windows is None else ["--windows", windows]
    words += ["--basin", str(basin)] if basin else []
    words += [word for assignment in assignments for word in ("--set", assignment)]
    words += [] if data is None else ["--data", str(data)]
    words += [] if topics is None else ["--map", str(topics)]
    return Request(plan, shlex.join(words), basin, {name: reason for name, reason in left_out.items() if reason})


class Found(NamedTuple):
    """What came of a request."""

    comparison: Comparison
    draws: list[Draw]
    basins: list[Basin]

    def document(self, command: str) -> dict[str, Any]:
        """Return what `leaderboard.json` holds."""
        packages, board = versions("coopenv", "numpy", "scipy", "warp-lang"), self.comparison
        content = {"command": command, "versions": packages, "seeds": board.seeds, "rows": board.rows}
        content["windows"] = board.window_rows
        return dict(jsonable(content | ({"basin": self.basins} if self.basins else {})))


def perform(
    request: Request,
    executor: Executor,
    out: Path | None,
    figures: str | None,
    printed: Console,
    log: Console,
    as_json: bool = False,
    width: str | None = None,
) -> None:
    """Compare, print the tables (or what `leaderboard.json` holds) and write the files to the folder `out`, if any.

    `figures` is the format of figures as files of their own; None: the report alone has them. `width` is a column of
    `coopenv.viz.paper` that they are drawn for; None: a page's.

    Raises:
        CoopenvError: something that was asked for does not exist, or cannot be written.
    """
    wanted = figure_files(request.plan.variants, figures)
    if wanted and out is None:
        raise CoopenvError(f"--figures {figures}: figures need a folder, --out DIR")
    found, names = None, [JSON_FILE, CSV_FILE, WINDOWS_FILE, LATEX_FILE, REPORT_FILE, BASIN_FILE]
    names += [name for form in FORMATS for name in figure_files(tuple(request.plan.source.variants), form)]
    try:
        with nullcontext() if out is None else replacing_folder(out, names) as folder:
            found = _compare(request, executor, log)
            if folder is not None:
                write_files(found, request.command, folder, wanted, width)
                names = sorted(path.name for path in folder.iterdir())
    finally:  # hours of work are told even if they cannot be written
        if found is not None and as_json:
            sys.stdout.write(json_text(found.document(request.command)))
        elif found is not None:
            print_tables(found, printed)
    if out is not None and not as_json:
        printed.print(f"Files in {out}: {', '.join(names)}", soft_wrap=True)


def _compare(request: Request, executor: Executor, log: Console) -> Found:
    for name, reason in request.left_out.items():
        log.print(f"left out: {name} ({reason})", soft_wrap=True, markup=False)
    plan, draws = request.plan, []
    with Progress(log, plan.work, total=1.0) as progress:
        comparison = plan.run(executor, progress.update)
    if request.basin:
        work = f"{len(plan.observers)} observers, {request.basin} initial estimates"
        with Progress(log, work, total=1.0) as progress:
            draws = study_basin(plan.source, plan.observers, request.basin, executor, progress.update)
    return Found(comparison, draws, basins_of(plan.source.name, draws))


def print_tables(found: Found, printed: Console) -> None:
    """Print the tables of the comparison and of the basins, and who failed."""
    printed.print(found.comparison)
    if found.basins:
        printed.print()
        printed.print(basin_table(found.basins))
    for line in basin_failures(found.basins):
        printed.print(line, soft_wrap=True)


def figure_files(variants: Sequence[str], form: str | None) -> dict[str, tuple[str, str]]:
    """Return the names of figures as files in a format, each with its kind and variant."""
    if form is None:
        return {}
    if form not in FORMATS:
        raise CoopenvError(f"--figures {form}: known are {', '.join(FORMATS)}")
    drawn = {f"{kind}-{_as_file(v)}.{form}": (kind, v) for v in variants for kind in ("errors", "consistency")}
    return drawn | {f"{kind}.{form}": (kind, variants[0]) for kind in ("cost", "variants")}


def _as_file(variant: str) -> str:
    """Return a variant's name as part of a file's name on any system."""
    return re.sub(r"[^A-Za-z0-9._+=-]", "_", variant)


def write_files(
    found: Found, command: str, out: Path, figures: Mapping[str, tuple[str, str]], width: str | None = None
) -> None:
    """Write the leaderboard as JSON and CSV, the draws as CSV, the report, and figures by name, kind and variant."""
    from coopenv.bench.observers.figures import KINDS
    from coopenv.bench.observers.report import report_text

    comparison, draws, basins = found
    content = found.document(command)
    texts = {JSON_FILE: json_text(content), CSV_FILE: comparison.to_csv()}
    texts[WINDOWS_FILE] = csv_text(comparison.window_rows)
    texts |= {BASIN_FILE: csv_text(draws)} if draws else {}
    texts[LATEX_FILE] = comparison.to_latex()
    texts[REPORT_FILE] = report_text(comparison, content, draws, basins)
    for name, text in texts.items():
        replace_text(out / name, text)
    for name, (kind, variant) in figures.items():
        if KINDS[kind](comparison, variant, None) is not None:
            comparison.figure(kind, variant=variant, width=width, path=out / name)
