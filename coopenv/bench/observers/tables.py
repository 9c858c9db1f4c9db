"""The leaderboard as tables that fit a terminal of 80 columns."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from rich.table import Table

from coopenv.bench.observers.faults import NOMINAL
from coopenv.bench.observers.rows import Row
from coopenv.bench.tables import number_table

MOST_COLUMNS = 6
"""Vehicles shown one by one; more are summed up as mean and worst."""

_LONG = 9  # characters of a word in a heading
BOUNDS = {"bound_m": "bound (joint)", "bound_ancestors_m": "bound (ancestors)", "bound_single_m": "bound (alone)"}
"""Column to its line in the table of errors."""


def by_observer(rows: Iterable[Row]) -> dict[str, list[Row]]:
    """Return the rows of every observer."""
    found: dict[str, list[Row]] = {}
    for row in rows:
        found.setdefault(row.observer, []).append(row)
    return found


def error_table(rows: Sequence[Row]) -> Table:
    """Return position RMSE in m of one variant per vehicle, the bounds first, with the worst ratios to them."""
    first = next(iter(by_observer(rows).values()))
    few = len(first) <= MOST_COLUMNS
    headings = [f"f{i + 1}" for i in range(len(first))] if few else ["mean", "worst"]
    bounded = {column: line for column, line in BOUNDS.items() if np.isfinite(getattr(first[0], column))}
    ratios = ["x joint\nworst", "x anc.\nworst"] if bounded else []
    table = number_table(["position RMSE [m]"], [*headings, *([] if bounded or not few else ["mean"]), *ratios], gap=0)
    for column, line in bounded.items():
        table.add_row(line, *_errors([getattr(row, column) for row in first], few))
    for name, own in by_observer(rows).items():
        if any(row.failure for row in own):
            table.add_row(name, *["failed"] * len(headings))
            continue
        errors = [row.position_rmse_m for row in own]
        cells = _errors(errors, few)
        if bounded:
            cells += [_number(max(row.ratio_to_bound for row in own), 3)]
            cells += [_number(max(row.ratio_to_bound_ancestors for row in own), 3)]
        elif few:
            cells += _errors([float(np.mean(errors))], True)
        table.add_row(name, *cells)
    return table


def honest_line(rows: Sequence[Row]) -> str:
    """Return where the ANEES of an honest filter lies, empty where nobody states a covariance."""
    bounds = [(row.anees_low, row.anees_high) for row in rows if np.isfinite(row.anees_low)]
    return (
        f"ANEES of an honest filter: 1 ({bounds[0][0]:.2f} to {bounds[0][1]:.2f} at 95 % of instants)" if bounds else ""
    )


def quality_table(rows: Sequence[Row]) -> Table:
    """Return, of one variant over all vehicles: who settles, consistency (1 is honest) and costs."""
    headings = ["set-\ntled", "con-\nverged", "di-\nverged", "ANEES\nbest", "ANEES\nworst", "NIS", "sent\nB/s", "us"]
    table = number_table(["observer"], headings, gap=0)
    for name, own in by_observer(rows).items():
        if any(row.failure for row in own):
            continue
        anees, nis = _finite(row.anees for row in own), _finite(row.nis for row in own)
        table.add_row(
            name,
            *(
                f"{100 * np.mean([getattr(row, column) for row in own]):.0f}%"
                for column in ("settled_fraction", "converged_fraction", "diverged_fraction")
            ),
            *((f"{min(anees):.2g}", f"{max(anees):.2g}") if anees else ("-", "-")),
            _number(float(np.mean(nis)), 2) if nis else "-",
            f"{np.mean([row.bytes_per_s for row in own]):.0f}",
            f"{np.mean([row.us_per_update for row in own]):.0f}",
        )
    return table


def variant_table(rows: Sequence[Row]) -> Table:
    """Return position RMSE in m, mean over the vehicles, of every observer in every variant."""
    variants = list(dict.fromkeys(row.variant for row in rows))
    table = number_table(["mean RMSE [m]"], [_heading(name) for name in variants], gap=0)
    for name, own in by_observer(rows).items():
        cells = []
        for variant in variants:
            part = [row for row in own if row.variant == variant]
            failed = any(row.failure for row in part)
            cells.append("failed" if failed else _errors([mean_rmse(part)], True)[0])
        table.add_row(name, *cells)
    return table


def degradation_table(rows: Sequence[Row]) -> Table:
    """Return how much worse than the nominal one every observer is in every other variant."""
    variants = [name for name in dict.fromkeys(row.variant for row in rows) if name != NOMINAL]
    table = number_table(["RMSE / nominal"], [_heading(name) for name in variants], gap=0)
    for name, own in by_observer(rows).items():
        table.add_row(name, *(_number(degradation(own, variant), 3) for variant in variants))
    return table


def degradation(rows: Sequence[Row], variant: str) -> float:
    """Return the mean RMSE of one observer's rows in a variant over that in the nominal one; NaN without one."""
    errors = {name: mean_rmse([row for row in rows if row.variant == name]) for name in (variant, NOMINAL)}
    return errors[variant] / errors[NOMINAL]


def _heading(variant: str) -> str:
    """Return a name on lines of few characters."""
    words = variant.replace("+", "_+").split("_")
    return "\n".join(word if len(word) <= _LONG else f"{word[:6]}-\n{word[6:]}" for word in words)


def mean_rmse(rows: Sequence[Row]) -> float:
    """Return the mean over vehicles of the position RMSE, m; NaN without any."""
    return float(np.mean([row.position_rmse_m for row in rows])) if rows else float("nan")


def failures(rows: Sequence[Row]) -> list[str]:
    """Return one line per observer that failed and way in which it did, with the variants."""
    failed: dict[tuple[str, str], dict[str, None]] = {}
    for row in rows:
        if row.failure:
            failed.setdefault((row.observer, row.failure), {})[row.variant] = None
    return [f"{observer} ({', '.join(variants)}): failed {why}" for (observer, why), variants in failed.items()]


def _errors(values: Sequence[float], few: bool) -> list[str]:
    shown = list(values) if few else [float(np.mean(values)), float(np.max(values))]
    return [f"{value:.4f}" if value < 1.0 else _number(value, 3) for value in shown]


def _number(value: float, digits: int) -> str:
    """Return at most five characters."""
    if not np.isfinite(value):
        return "-"
    return f"{value:.{digits}g}" if value < 10**digits else f"{value:.0f}" if value < 1e5 else f"{value:.0e}"


def _finite(values: Iterable[float]) -> list[float]:
    return [value for value in values if np.isfinite(value)]
