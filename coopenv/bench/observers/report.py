"""The report: one HTML file that holds its figures and needs no network."""

import io
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from matplotlib.figure import Figure

from coopenv.bench.observers.basin import RADIUS, Basin, Draw, basin_failures
from coopenv.bench.observers.basin_figure import basin_figure
from coopenv.bench.observers.faults import NOMINAL
from coopenv.bench.observers.figures import KINDS
from coopenv.bench.observers.leaderboard import BOUNDS, Leaderboard
from coopenv.bench.observers.rows import Row, mean_of
from coopenv.bench.observers.tables import failures, honest_line
from coopenv.bench.observers.windows import spread
from coopenv.estimation.metrics import CONVERGED
from coopenv.format import number, with_error

_COORDINATE = re.compile(r"(?<=[ML ])(-?\d+\.\d\d)\d+(?=[ \n])")
"""A coordinate of a line in SVG, of which hundredths of a point are enough."""


def report_text(
    board: Leaderboard, content: Mapping[str, Any], draws: Sequence[Draw] = (), basins: Sequence[Basin] = ()
) -> str:
    """Return the report as one HTML text; `content` of `leaderboard.json` tells the command and versions."""
    variants = [_variant(board, name) for name in board.variants]
    nominal = variants[0]["name"] == NOMINAL
    return (
        _environment()
        .get_template("report.html.j2")
        .render(
            board=board,
            content=content,
            vehicles=board.samples[0].scene.vehicles,
            boards=variants[:1] if nominal else variants,  # faults have one table
            variants=variants,
            nominal=nominal,
            honest=honest_line(board.rows),
            failures=failures(board.rows),
            heat=_picture(board, "variants", variants[0]["name"]),
            cost=_picture(board, "cost", variants[0]["name"]),
            basins=basins,
            basin_failures=basin_failures(basins),
            basin_map=_svg(basin_figure(board.environment, draws)) if draws else "",
            radius=RADIUS,
            tolerance=CONVERGED.text,
            columns=[f.name for f in fields(Row) if f.name not in ("environment", "failure")],
            definitions={f.name: f.metadata["meaning"] for f in fields(Row)},
        )
    )


def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("coopenv.bench.observers", ""), autoescape=True, undefined=StrictUndefined
    )
    environment.globals |= {"with_error": with_error, "extremes": _extremes, "mean": mean_of, "nan": math.nan}
    environment.filters["append"] = lambda text, more: text + more
    return environment


def _variant(board: Leaderboard, name: str) -> dict[str, Any]:
    """Return what the template shows of one variant."""
    return {
        "name": name,
        "summary": board.variants[name],
        "bounds": {BOUNDS[column]: values for column, values in board.bounds_in(name).items()},
        "paper_noise": board.samples[0].scene.paper_noise,
        "observers": {
            observer: {"rows": board.rows_in(name, observer), "total": board.totals[name, observer]}
            for observer in board.ranked
        },
        "windows": {observer: _windows(board, name, observer) for observer in board.ranked},
        "errors": _picture(board, "errors", name),
        "consistency": _picture(board, "consistency", name),
    }


def _windows(board: Leaderboard, variant: str, observer: str) -> list[dict[str, Any]]:
    """Return what the template shows of one observer by window; the steady state alone is no table."""
    found = [(window, board.windows_in(variant, observer, window)) for window in board.windows]
    columns = ("ratio_to_bound_ancestors", "anees")
    return [
        {"name": window.name, "rows": rows, **{column: spread(rows, column) for column in columns}}
        for window, rows in (found if len(found) > 1 else ())
    ]


def _extremes(rows: Sequence[Row], column: str) -> str:
    finite = [value for row in rows if math.isfinite(value := getattr(row, column))]
    return f"{number(min(finite), 3)} … {number(max(finite), 3)}" if finite else "-"


def _picture(board: Leaderboard, kind: str, variant: str) -> str:
    """Return a figure as SVG for the page, empty where there is nothing to draw."""
    figure = KINDS[kind](board, variant, None)
    return "" if figure is None else _svg(figure)


def _svg(figure: Figure) -> Markup:
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None})
    text = buffer.getvalue()
    text = _COORDINATE.sub(r"\1", text[text.index("<svg") :])
    return Markup(text)  # drawn here, so that it needs no escaping
