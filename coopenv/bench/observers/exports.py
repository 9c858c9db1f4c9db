"""The leaderboard as CSV and LaTeX."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from dataclasses import asdict
from io import StringIO

from coopenv.bench.observers.basin import Draw
from coopenv.bench.observers.leaderboard import BOUNDS, Leaderboard
from coopenv.bench.observers.rows import Row
from coopenv.format import number, with_error
from coopenv.jsonable import jsonable


def csv_text(rows: Sequence[Row] | Sequence[Draw]) -> str:
    """Return rows as CSV; figures that do not exist are empty."""
    table = [jsonable(asdict(row)) for row in rows]
    text = StringIO()
    writer = csv.DictWriter(text, fieldnames=list(table[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(table)
    return text.getvalue()


def latex(board: Leaderboard, variant: str) -> str:
    """Return position RMSE per vehicle in m with standard errors as a LaTeX table."""
    vehicles = [_escaped(vehicle) for vehicle in board.samples[0].scene.vehicles]
    bounds = [[BOUNDS[c], *(f"${number(v, 3)}$" for v in values)] for c, values in board.bounds_in(variant).items()]
    observers = [[_escaped(name), *map(_cell, board.rows_in(variant, name))] for name in board.ranked]
    return "\n".join(
        [
            f"% {board.title}, {variant}: position RMSE in m with standard errors over the seeds. Needs booktabs.",
            rf"\begin{{tabular}}{{l{'r' * len(vehicles)}}}",
            r"\toprule",
            _line(["", *vehicles]),
            r"\midrule",
            *map(_line, bounds),
            *([r"\midrule"] if bounds else []),
            *map(_line, observers),
            r"\bottomrule",
            r"\end{tabular}",
            "",
        ]
    )


def _line(cells: Sequence[str]) -> str:
    return " & ".join(cells) + r" \\"


def _escaped(text: str) -> str:
    """Return a text in which LaTeX's special characters stand for themselves."""
    return re.sub(r"([&%$#_{}])", r"\\\1", text.replace("\\", "/"))


def _cell(row: Row) -> str:
    if row.failure:
        return "failed"
    value, error = with_error(row.position_rmse_m, row.position_rmse_se_m)
    return rf"${value} \pm {error}$" if error else f"${value}$"
