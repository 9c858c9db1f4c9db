"""The leaderboard as JSON, CSV, LaTeX and a pandas table."""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from coopenv.bench.observers.leaderboard import Leaderboard
from coopenv.bench.observers.rows import Row
from coopenv.bench.observers.tables import BOUNDS, bounded
from coopenv.errors import CoopenvError
from coopenv.files import replacing_file
from coopenv.format import number, with_error
from coopenv.jsonable import jsonable
from coopenv.machine import versions

if TYPE_CHECKING:
    from pandas import DataFrame

FORMATS = ("png", "pdf", "svg")
"""Formats of figures."""


def document(board: Leaderboard, command: str, **more: Any) -> dict[str, Any]:
    """Return what `leaderboard.json` holds, as plain data; figures that do not exist are null."""
    packages = versions("coopenv", "numpy", "scipy", "warp-lang")
    rows = [asdict(row) for row in board.rows]
    content = {"command": command, "versions": packages, "seeds": list(board.seeds), "rows": rows, **more}
    return dict(jsonable(content))


def csv_text(rows: Sequence[Row] | Sequence[Mapping[str, Any]]) -> str:
    """Return rows as CSV; figures that do not exist are empty."""
    table = [jsonable(asdict(row) if isinstance(row, Row) else row) for row in rows]
    text = StringIO()
    writer = csv.DictWriter(text, fieldnames=list(table[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(table)
    return text.getvalue()


def data_frame(rows: Sequence[Row]) -> DataFrame:
    """Return rows as a pandas table.

    Raises:
        CoopenvError: pandas is not installed.
    """
    try:
        from pandas import DataFrame
    except ImportError:
        raise CoopenvError("a table of pandas needs pandas: pip install pandas") from None
    return DataFrame([asdict(row) for row in rows], columns=[f.name for f in fields(Row)])


def latex(board: Leaderboard, variant: str) -> str:
    """Return position RMSE per vehicle in m with standard errors as a LaTeX table."""
    vehicles = [escaped(vehicle) for vehicle in board.samples[0].scene.vehicles]
    lines = [
        f"% {board.title}, {variant}: position RMSE in m with standard errors over the seeds. Needs booktabs.",
        rf"\begin{{tabular}}{{l{'r' * len(vehicles)}}}",
        r"\toprule",
        " & ".join(["", *vehicles]) + r" \\",
        r"\midrule",
    ]
    bounds = bounded(board, variant)
    for column, values in bounds.items():
        lines.append(" & ".join([BOUNDS[column], *(f"${number(value, 3)}$" for value in values)]) + r" \\")
    lines += [r"\midrule"] if bounds else []
    for name in board.ranked:
        own = board.rows_in(variant, name)
        cells = [_cell(row) for row in own]
        lines.append(" & ".join([escaped(name), *cells]) + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", ""])


def escaped(text: str) -> str:
    """Return a text in which LaTeX's special characters stand for themselves."""
    return re.sub(r"([&%$#_{}])", r"\\\1", text.replace("\\", "/"))


def _cell(row: Row) -> str:
    if row.failure:
        return "failed"
    value, error = with_error(row.position_rmse_m, row.position_rmse_se_m)
    return rf"${value} \pm {error}$" if error else f"${value}$"


def text_to(path: str | Path | None, text: str) -> str:
    """Write a text where a path is given, and return it.

    Raises:
        OutputError: it cannot be written.
    """
    if path is not None:
        with replacing_file(path) as new:
            new.write_text(text, encoding="utf-8")
    return text
