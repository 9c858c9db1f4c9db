"""The report: one HTML file that holds its figures and needs no network."""

import io
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from matplotlib.figure import Figure

from coopenv.base.format import with_error
from coopenv.bench.observers.basin import RADIUS, Basin, Draw, basin_failures
from coopenv.bench.observers.basin_figure import basin_figure
from coopenv.bench.observers.charts import chart_data, page_file, plotly
from coopenv.bench.observers.faults import NOMINAL
from coopenv.bench.observers.leaderboard import BOUNDS, Leaderboard
from coopenv.bench.observers.quality import headline, quality
from coopenv.bench.observers.rows import Row
from coopenv.bench.observers.tables import failures, honest_line
from coopenv.bench.observers.windows import spread
from coopenv.estimation.metrics import CONVERGED

MOST_BYTES = 1_950_000
"""Of a report: more than that mails badly and opens slowly on a phone."""
_COORDINATE = re.compile(r"(?<=[ML ])(-?\d+\.\d\d)\d+(?=[ \n])")
"""A coordinate of a line in SVG, of which hundredths of a point are enough."""


def report_text(
    board: Leaderboard, content: Mapping[str, Any], draws: Sequence[Draw] = (), basins: Sequence[Basin] = ()
) -> str:
    """Return the report as one HTML text; `content` of `leaderboard.json` tells the command and versions."""
    text = _rendered(board, content, draws, basins, with_rows=True)
    return text if len(text.encode()) < MOST_BYTES else _rendered(board, content, draws, basins, with_rows=False)


def _rendered(
    board: Leaderboard, content: Mapping[str, Any], draws: Sequence[Draw], basins: Sequence[Basin], with_rows: bool
) -> str:
    variants = [_variant(board, name) for name in board.variants]
    nominal = variants[0]["name"] == NOMINAL
    return (
        _environment(board)
        .get_template("report.html.j2")
        .render(
            board=board,
            with_rows=with_rows,
            headline=headline(board),
            data=chart_data(board),
            plotly=plotly(),
            charts=Markup(page_file("charts.js").decode()),
            content=content,
            vehicles=board.samples[0].scene.vehicles,
            boards=variants[:1] if nominal else variants,  # faults have one table
            variants=variants,
            nominal=nominal,
            honest=honest_line(board.rows),
            failures=failures(board.rows),
            basins=basins,
            basin_failures=basin_failures(basins),
            basin_map=_svg(basin_figure(board.environment, draws)) if draws else "",
            radius=RADIUS,
            tolerance=CONVERGED.text,
            columns=[f.name for f in fields(Row) if f.name not in ("environment", "failure")],
            definitions={f.name: f.metadata["meaning"] for f in fields(Row)},
        )
    )


def _environment(board: Leaderboard) -> Environment:
    environment = Environment(
        loader=PackageLoader("coopenv.bench.observers", "page"), autoescape=True, undefined=StrictUndefined
    )
    environment.globals |= {"with_error": with_error, "breakable": _breakable, "tint": _tints(board), "nan": math.nan}
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
            observer: {
                "rows": board.rows_in(name, observer),
                "total": board.totals[name, observer],
                **quality(board, name, observer),
            }
            for observer in board.ranked
        },
        "windows": {observer: _windows(board, name, observer) for observer in board.ranked},
    }


def _windows(board: Leaderboard, variant: str, observer: str) -> list[dict[str, Any]]:
    """Return what the template shows of one observer by window; the steady state alone is no table."""
    found = [(window, board.windows_in(variant, observer, window)) for window in board.windows]
    columns = ("ratio_to_bound_ancestors", "anees")
    return [
        {"name": window.name, "rows": rows, **{column: spread(rows, column) for column in columns}}
        for window, rows in (found if len(found) > 1 else ())
    ]


def _breakable(name: str) -> Markup:
    """Return a name that may be broken after underscores."""
    return Markup("<wbr>").join(re.split(r"(?<=_)", name))


def _tints(board: Leaderboard) -> Callable[[float], Markup]:
    """Return what gives a cell of the table of variants the darker a background, the larger its error."""
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
