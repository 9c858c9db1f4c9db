"""The report's tables, as HTML."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import fields
from html import escape

import numpy as np

from coopenv.bench.observers.basin import Basin
from coopenv.bench.observers.rows import Row
from coopenv.bench.observers.tables import BOUNDS, by_observer, degradation, mean_rmse

_NAMES = ("environment", "variant", "observer", "vehicle")
_LEAST_SHOWN = 1e-3


def overview(rows: Sequence[Row]) -> str:
    """Return one line per observer of one variant: errors by vehicle beside the bounds, consistency and costs."""
    groups = by_observer(rows)
    first = next(iter(groups.values()))
    bounded = {column: line for column, line in BOUNDS.items() if math.isfinite(getattr(first[0], column))}
    vehicles = [f"{row.vehicle} [m]" for row in first]
    ratios = ["worst / joint bound", "worst / ancestors' bound"] if bounded else []
    rest = ["orient. [deg]", "ANEES, lowest … highest", "NIS", "settled", "diverged", "sent [bytes/s]", "update [µs]"]
    lines = [
        _line([line, *(_cell(getattr(row, column)) for row in first)], "bound") for column, line in bounded.items()
    ]
    for name, own in groups.items():
        if any(row.failure for row in own):
            lines.append(_line([name, *["failed"] * len(vehicles)]))
            continue
        cells = [_cell(row.position_rmse_m) for row in own]
        if bounded:
            cells += [
                _cell(max(getattr(row, r) for row in own)) for r in ("ratio_to_bound", "ratio_to_bound_ancestors")
            ]
        cells.append(_cell(float(np.mean([row.orientation_rmse_deg for row in own]))))
        cells += [_range([row.anees for row in own]), _range([row.nis for row in own])]
        cells += [
            f"{100 * np.mean([getattr(r, c) for r in own]):.0f} %" for c in ("settled_fraction", "diverged_fraction")
        ]
        cells += [f"{np.mean([getattr(row, c) for row in own]):,.0f}" for c in ("bytes_per_s", "us_per_update")]
        lines.append(_line([name, *cells]))
    return _table(["observer", *vehicles, *ratios, *rest], lines)


def variants_table(rows: Sequence[Row]) -> str:
    """Return the mean position RMSE by observer and variant, and how much worse than the nominal one it is."""
    variants = list(dict.fromkeys(row.variant for row in rows))
    lines = []
    for name, own in by_observer(rows).items():
        cells: list[str] = []
        for variant in variants:
            part = [row for row in own if row.variant == variant]
            ratio = degradation(own, variant)
            factor = f" <span class='factor'>× {_short(ratio)}</span>" if math.isfinite(ratio) and cells else ""
            cells.append("failed" if any(row.failure for row in part) else _cell(mean_rmse(part)) + factor)
        lines.append(_line([name, *cells]))
    return _table(["observer", *variants], lines)


def full_table(rows: Sequence[Row]) -> str:
    """Return every column of every row."""
    columns = [f.name for f in fields(Row) if f.name not in ("environment", "failure")]
    body, before = [], None
    for row in rows:
        kind = "first" if before != (row.variant, row.observer) else ""
        before = (row.variant, row.observer)
        body.append(_line([_cell(getattr(row, name)) for name in columns], kind, names=3))
    return _table([name.replace("_", "_<wbr>") for name in columns], body, names=3)


def basin_table(basins: Sequence[Basin]) -> str:
    """Return one line per observer: how many draws converge."""
    lines = [
        _line(
            [
                escape(b.observer),
                str(b.draws),
                str(b.failed),
                f"{100 * b.converged_fraction:.1f} %",
                f"{100 * b.interval.low:.1f}–{100 * b.interval.high:.1f} %",
                f"{', '.join(f'{100 * share:.0f}' for share in b.by_vehicle)} %",
                _cell(b.convergence_time_s),
            ]
        )
        for b in basins
    ]
    return _table(
        [
            "observer",
            "draws",
            "failed",
            "all vehicles converge",
            "95 % interval",
            "by vehicle",
            "last one converges, median [s]",
        ],
        lines,
    )


def failure_list(lines: Sequence[str]) -> str:
    """Return who failed, when and why, one line each; nothing where nobody did."""
    return "<ul class='failure'>" + "".join(f"<li>{escape(line)}</li>" for line in lines) + "</ul>" if lines else ""


def definitions() -> str:
    """Return what every column means."""
    lines = [f"<dt>{f.name}</dt><dd>{escape(f.metadata['meaning'])}</dd>" for f in fields(Row)]
    return "<dl>" + "".join(lines) + "</dl>"


def _table(headings: Sequence[str], lines: Sequence[str], names: int = 1) -> str:
    head = "".join(f"<th{_class(n < names)}>{heading}</th>" for n, heading in enumerate(headings))
    return f'<div class="scroll"><table><tr>{head}</tr>\n' + "\n".join(lines) + "</table></div>"


def _line(cells: Sequence[str], kind: str = "", names: int = 1) -> str:
    body = "".join(f"<td{_class(n < names)}>{cell}</td>" for n, cell in enumerate(cells))
    return f'<tr class="{kind}">{body}</tr>' if kind else f"<tr>{body}</tr>"


def _class(is_name: bool) -> str:
    return ' class="name"' if is_name else ""


def _cell(value: str | float) -> str:
    """Return a name, or a number with three digits that count."""
    if isinstance(value, str):
        return escape(value)
    if not math.isfinite(value):
        return "–"
    if value != 0.0 and not _LEAST_SHOWN <= abs(value) < 1e5:
        return f"{value:.1e}"
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:#.3g}".rstrip(".")


def _range(values: Sequence[float]) -> str:
    finite = [value for value in values if math.isfinite(value)]
    return f"{_cell(min(finite))} … {_cell(max(finite))}" if finite else "–"


def _short(ratio: float) -> str:
    return f"{ratio:.2f}" if ratio < 10 else _cell(ratio)
