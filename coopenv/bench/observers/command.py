"""`coopenv bench observers`: from the options to tables and files."""

import io
import math
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from markupsafe import Markup
from matplotlib.figure import Figure
from rich.console import Console

from coopenv.base.errors import CoopenvError, listed
from coopenv.base.files import replace_text, replacing_folder
from coopenv.base.format import json_text, jsonable, with_error
from coopenv.base.installation import versions
from coopenv.bench.executors import Executor
from coopenv.bench.observers.comparison import Comparison, Plan
from coopenv.bench.observers.convergence import RADIUS, basin_failures, study_basin
from coopenv.bench.observers.faults import NOMINAL
from coopenv.bench.observers.figures import KINDS, PLOTLY, basin_figure, chart_data, packed, page_file, stanford_figure
from coopenv.bench.observers.rows import BOUNDS, Leaderboard, Row, spread
from coopenv.bench.observers.tables import (
    failures,
    headline,
    honest_line,
    level_figures,
    quality,
)
from coopenv.estimation.metrics import CONVERGED
from coopenv.report.table import Table
from coopenv.report.templates import templates
from coopenv.runs.console import Progress, note_overwritten
from coopenv.scenario.schema import BEARINGS_ALONE
from coopenv.viz import FORMATS

JSON_FILE, CSV_FILE, REPORT_FILE, BASIN_FILE = "leaderboard.json", "leaderboard.csv", "report.html", "basin.csv"
WINDOWS_FILE, LATEX_FILE = "windows.csv", "leaderboard.tex"


def perform(
    plan: Plan,
    command: str,
    executor: Executor,
    printed: Console,
    log: Console,
    *,
    basin: int = 0,
    out: Path | None = None,
    figures: str | None = None,
    width: str | None = None,
    as_json: bool = False,
) -> Leaderboard:
    """Compare, print the tables (or JSON), write the files, and return the comparison.

    Args:
        plan: the comparison.
        command: the command line that gives the same table again.
        executor: executor of the observers.
        printed: console of the tables.
        log: console of the progress.
        basin: draws of initial estimates; 0: no study of basins.
        out: folder of the files; None: no files.
        figures: format of figures as files of their own; None: figures are in the report alone.
        width: column of `coopenv.viz.figures` that these figures are drawn for; None: a page's.
        as_json: print the content of `leaderboard.json` in place of the tables.

    Raises:
        CoopenvError: something that was asked for does not exist, or cannot be written.
    """
    found, wanted = None, figure_files(plan.variants, figures)
    if wanted and out is None:
        raise CoopenvError(f"--figures {figures}: figures need a folder, --out DIR")
    names = [JSON_FILE, CSV_FILE, WINDOWS_FILE, LATEX_FILE, REPORT_FILE, BASIN_FILE]
    names += [name for form in FORMATS for name in figure_files(tuple(plan.source.variants), form)]
    try:
        with nullcontext() if out is None else replacing_folder(out, names) as folder:
            note_overwritten(out, names, log)
            for name, reason in plan.left_out.items():
                log.print(f"left out: {name} ({reason})", soft_wrap=True, markup=False)
            if plan.source.sensor_sets and (ignoring := [name for name in plan.observers if name in BEARINGS_ALONE]):
                log.print(f"note: {listed(ignoring)}: bearings of the camera alone, other sensors are ignored")
            with Progress(log, plan.work, total=1.0) as progress:
                found = plan.run(executor, progress.update)
            if basin:
                work = f"{len(plan.observers)} observers, {basin} initial estimates"
                with Progress(log, work, total=1.0) as progress:
                    draws = study_basin(plan.source, plan.observers, basin, executor, progress.update)
                found = replace(found, draws=draws)
            if folder is not None:
                with Progress(log, "writing tables and report"):
                    write_files(found, command, folder, wanted, width)
                names = sorted(path.name for path in folder.iterdir())
    finally:  # hours of work are printed even if they cannot be written
        if found is not None and as_json:
            sys.stdout.write(json_text(document(found, command)))
        elif found is not None:
            printed.print(found)
    if out is not None and not as_json:
        printed.print(f"Files in {out}: {', '.join(names)}", soft_wrap=True)
    return found


def document(board: Leaderboard, command: str) -> dict[str, Any]:
    """Return the content of `leaderboard.json`."""
    packages = versions("coopenv", "numpy", "scipy", "warp-lang")
    content = {"command": command, "versions": packages, "seeds": board.seeds, "rows": board.rows}
    content |= {"standard_errors_over": board.sampled}
    content["windows"] = board.window_rows
    return dict(jsonable(content | ({"basin": board.basins} if board.basins else {})))


def figure_files(variants: Sequence[str], form: str | None) -> dict[str, tuple[str, str]]:
    """Return the names of figures as files in a format, each with its kind and variant."""
    if form is None:
        return {}
    if form not in FORMATS:
        raise CoopenvError(f"--figures {form}: known are {', '.join(FORMATS)}")
    stems = {v: re.sub(r"[^A-Za-z0-9._+=-]", "_", v) for v in variants}  # which any system takes as a file's name
    kinds = ("errors", "consistency", "protection")
    drawn = {f"{kind}-{stem}.{form}": (kind, v) for v, stem in stems.items() for kind in kinds}
    return drawn | {f"{kind}.{form}": (kind, variants[0]) for kind in ("cost", "variants")}


def write_files(
    board: Comparison, command: str, out: Path, figures: Mapping[str, tuple[str, str]], width: str | None
) -> None:
    """Write the leaderboard as JSON and CSV, the draws as CSV, the report, and figures by name, kind and variant."""
    content = document(board, command)
    texts = {JSON_FILE: json_text(content), CSV_FILE: board.to_csv(), WINDOWS_FILE: board.to_csv(windows=True)}
    texts |= {BASIN_FILE: Table.of_rows(board.draws).csv()} if board.draws else {}
    texts |= {LATEX_FILE: board.to_latex(), REPORT_FILE: report_text(board, content)}
    for name, text in texts.items():
        replace_text(out / name, text)
    for name, (kind, variant) in figures.items():
        if KINDS[kind](board, variant, None) is not None:
            board.figure(kind, variant=variant, width=width, path=out / name)


MOST_BYTES = 1_950_000
"""Largest report: a larger file mails badly and opens slowly on a phone."""
_COORDINATE = re.compile(r"(?<=[ML ])(-?\d+\.\d\d)\d+(?=[ \n])")
"""A coordinate of a line in SVG, of which hundredths of a point are enough."""


def report_text(board: Leaderboard, content: Mapping[str, Any]) -> str:
    """Return the report as one HTML text; `content` of `leaderboard.json` has the command and versions."""
    variants = [_variant(board, name) for name in board.variants]
    nominal = variants[0]["name"] == NOMINAL
    values: dict[str, Any] = {
        "board": board,
        "headline": headline(board),
        "data": chart_data(board),
        "plotly": packed(page_file(PLOTLY)),
        "charts": Markup(page_file("charts.js").decode()),
        "content": content,
        "boards": variants[:1] if nominal else variants,  # faults have one table
        "variants": variants,
        "nominal": nominal,
        "honest": honest_line(board.rows),
        "failures": failures(board.rows),
        "basin_failures": basin_failures(board.basins),
        "basin_map": _svg(basin_figure(board)) if board.draws else "",
        "radius": RADIUS,
        "tolerance": CONVERGED.text,
        "columns": [f.name for f in fields(Row) if f.name not in ("environment", "failure")],
        "definitions": {f.name: f.metadata["meaning"] for f in fields(Row)},
    }
    texts = templates("coopenv.bench.observers", "page", autoescape=True)
    texts.globals |= {"with_error": with_error, "spread": spread, "tint": _tints(board), "nan": math.nan}
    texts.globals["breakable"] = lambda name: Markup("<wbr>").join(re.split(r"(?<=_)", name))
    texts.filters["append"] = lambda text, more: text + more
    template = texts.get_template("report.html.j2")
    text = template.render(values, with_rows=True)
    return text if len(text.encode()) < MOST_BYTES else template.render(values, with_rows=False)


def _variant(board: Leaderboard, name: str) -> dict[str, Any]:
    """Return the template's entries of one variant."""
    return {
        "name": name,
        "summary": board.variants[name],
        "bounds": {BOUNDS[column]: values for column, values in board.bounds_in(name).items()},
        "paper_noise": board.samples[0].scene.paper_noise,
        "observers": {observer: quality(board, name, observer) for observer in board.ranked},
        "levels": level_figures(board, name),
        "stanford": "" if (drawn := stanford_figure(board, name)) is None else _svg(drawn),
    }


def _tints(board: Leaderboard) -> Callable[[float], Markup]:
    """Return the style of the table of variants: the larger the error, the darker the cell's background."""
    sizes = [math.log(total.rmse.value) for total in board.totals.values() if total.rmse.value > 0]
    low, high = min(sizes, default=0.0), max(sizes, default=1.0)

    def tint(value: float) -> Markup:
        if not value > 0:
            return Markup("")
        share = (math.log(value) - low) / max(high - low, 1e-9)
        return Markup(f' style="background: rgb(213 94 0 / {0.45 * share:.2f})"')  # text stays legible on it

    return tint


def _svg(figure: Figure) -> Markup:
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None})
    text = buffer.getvalue()
    text = _COORDINATE.sub(r"\1", text[text.index("<svg") :])
    return Markup(text)  # drawn here, so that it needs no escaping
