"""The samples of a comparison of observers, and its tables."""

import csv
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from io import StringIO
from typing import Any

import numpy as np
from rich.table import Table

from coopenv.base.format import in_parentheses, jsonable, number, with_error
from coopenv.bench.observers.basin import Draw
from coopenv.bench.observers.faults import NOMINAL, VARIANTS
from coopenv.bench.observers.judge import Sample, Window
from coopenv.bench.observers.rows import (
    ERRORS,
    FAILED,
    Measured,
    Row,
    Spread,
    Total,
    WindowRow,
    compact,
    mean_of,
    rows_of,
    short_name,
    spread,
    standard_error,
    totals_of,
    window_rows,
)
from coopenv.bench.observers.sources import Robots
from coopenv.estimation.metrics import SETTLED
from coopenv.estimation.poses import Array
from coopenv.runs.console import number_table

BOUNDS = {"bound_m": "bound (joint)", "bound_ancestors_m": "bound (ancestors)", "bound_single_m": "bound (alone)"}
"""Column to its line in tables."""


@dataclass(frozen=True)
class Leaderboard:
    """How observers did on the same records, summed up over seeds."""

    environment: str
    """Name of the environment, dataset or log file."""
    observers: tuple[str, ...]
    variants: Mapping[str, str]
    """Those that were run, each with what it is."""
    seeds: tuple[int, ...]
    samples: Sequence[Sample] = field(repr=False)
    """One observer on one record each, by variant, observer, seed."""

    @cached_property
    def rows(self) -> list[Row]:
        """One per variant, observer and vehicle."""
        return rows_of(self.environment, self.samples)

    @cached_property
    def window_rows(self) -> list[WindowRow]:
        """One per variant, observer, window and vehicle; the last window is the steady state."""
        return window_rows(self.environment, self.samples)

    @cached_property
    def totals(self) -> dict[tuple[str, str], Total]:
        """Over all vehicles, by variant and observer."""
        return totals_of(self.samples)

    @cached_property
    def ranked(self) -> list[str]:
        """The observers by their error in the first variant, those that failed there last."""
        first = next(iter(self.variants))
        error = {name: self.totals[first, name].rmse.value for name in self.observers}
        return sorted(self.observers, key=lambda name: (error[name] != error[name], error[name]))

    @property
    def title(self) -> str:
        """What was compared, on one line."""
        first, last = self.seeds[0], self.seeds[-1]
        whole = len(self.seeds) > 1 and self.seeds == tuple(range(first, last + 1))
        seeds = f"{first} to {last}" if whole else ", ".join(map(str, self.seeds))
        return f"{self.environment}, seed{'s' if len(self.seeds) > 1 else ''} {seeds}"

    def rows_in(self, variant: str, observer: str) -> list[Row]:
        """Return the rows of one observer in one variant, a vehicle each."""
        return [row for row in self.rows if (row.variant, row.observer) == (variant, observer)]

    @property
    def windows(self) -> tuple[Window, ...]:
        """The stretches of the run that are judged one by one, the steady state last."""
        return self.samples[0].scene.windows

    def windows_in(self, variant: str, observer: str, window: Window) -> list[WindowRow]:
        """Return the rows of one observer in one variant and window, a vehicle each."""
        wanted = (variant, observer, window.name)
        return [row for row in self.window_rows if (row.variant, row.observer, row.window) == wanted]

    def bounds_in(self, variant: str) -> dict[str, list[float]]:
        """Return the bounds that are known of each vehicle in a variant, by column."""
        first = self.rows_in(variant, self.observers[0])
        found = {column: [float(getattr(row, column)) for row in first] for column in BOUNDS}
        return {column: values for column, values in found.items() if np.isfinite(values).all()}

    def samples_in(self, variant: str) -> dict[str, list[Sample]]:
        """Return the samples of one variant of every observer that did not fail, the best first."""
        own = {name: [s for s in self.samples if (s.variant, s.observer) == (variant, name)] for name in self.ranked}
        return {name: samples for name, samples in own.items() if not any(sample.failure for sample in samples)}


def quality(board: Leaderboard, variant: str, observer: str) -> dict[str, Any]:
    """Return shares in %, costs and NIS with standard errors, and the rows with the largest and smallest figures.

    Vehicles of one seed may depend on one another: errors are those of the means of each seed.
    """
    own = [s for s in board.samples if (s.variant, s.observer) == (variant, observer)]
    rows = board.rows_in(variant, observer)
    stated = sorted((row for row in rows if np.isfinite(row.anees)), key=lambda row: row.anees)
    dof = _each(own, "nis_dof").sum(axis=1)
    nis = _each(own, "nis").sum(axis=1) / np.where(dof > 0, dof, np.nan)
    return {
        "settled": _share(np.isfinite(_each(own, "settle_time"))),
        "diverged": _share(_each(own, "diverged")),
        "sent": _measured(np.array([s.bytes_per_s for s in own]).mean(axis=1)),
        "time": _measured(np.array([s.us_per_update for s in own]).mean(axis=1)),
        "nis": _measured(nis),
        "worst_ratio": max(rows, key=lambda row: row.ratio_to_bound_ancestors),
        "low_anees": stated[0] if stated else None,
        "high_anees": stated[-1] if stated else None,
        "worst_anees": max(stated, key=_dishonesty) if stated else None,
    }


def headline(board: Leaderboard) -> list[str]:
    """Summarise the first variant in a few sentences: the best observer, its lead, and the observers that settle."""
    first = next(iter(board.variants))
    names = [name for name in board.ranked if not any(row.failure for row in board.rows_in(first, name))]
    if not names:
        return ["Every observer failed."]
    best = quality(board, first, names[0])
    lines = [
        f"Best of {len(board.observers)} in {board.title} ({first}): {names[0]}, "
        f"mean position RMSE {_words(board.totals[first, names[0]].rmse)} m in the steady state"
    ]
    row = best["worst_ratio"]
    if np.isfinite(row.ratio_to_bound_ancestors):
        ratio = Measured(row.ratio_to_bound_ancestors, row.ratio_to_bound_ancestors_se)
        lines[0] += f", {_words(ratio)} times the Cramér-Rao bound at worst ({row.vehicle})"
    if len(names) > 1:
        lines[0] += f"; {names[1]} follows with {_words(board.totals[first, names[1]].rmse)} m"
    always = [name for name in names if quality(board, first, name)["settled"].value == 100.0]
    winners = ", ".join(always) if always else "none"
    return [lines[0] + ".", f"Every vehicle settles below {SETTLED.text} in every seed with: {winners}."]


def _words(measured: Measured) -> str:
    value, error = with_error(*measured)
    return f"{value} ± {error}" if error else value


def _dishonesty(row: Row) -> float:
    return float(abs(np.log(row.anees))) if row.anees > 0 else np.inf


def _each(samples: list[Sample], name: str) -> Array:
    """Return (S, N) a measure of every seed and vehicle."""
    return np.array([sample.measured(name) for sample in samples], float)


def _share(values: Array) -> Measured:
    return _measured(100.0 * np.asarray(values, float).mean(axis=1))


def _measured(each: Array) -> Measured:
    return Measured(float(each.mean()), standard_error(each))


MOST_OBSERVERS = 4  # with a column per vehicle
NAMES, COLUMN = 26, 9  # characters on a line: of observer and window, and of each vehicle


def window_tables(board: Leaderboard, variant: str, width: int) -> Iterator[Table | str]:
    """Yield ratios and consistency of one variant by window; nothing where there is the steady state alone.

    `width`: characters that fit on a line.
    """
    if len(board.windows) < 2:
        return
    vehicles = len(board.samples[0].scene.vehicles)
    few = NAMES + COLUMN * vehicles <= width and len(board.observers) <= MOST_OBSERVERS
    if few and board.bounds_in(variant):
        yield ""
        yield by_vehicle(board, variant, "RMSE / bound\n(ancestors)", "ratio_to_bound_ancestors")
    elif few:
        yield ""
        yield by_vehicle(board, variant, "position RMSE\n[m]", "position_rmse_m")
    if few:
        yield ""
        yield by_vehicle(board, variant, "ANEES", "anees")
    else:
        yield ""
        yield summary(board, variant)
        yield "Ratio to the ancestors' bound; worst ANEES: the farthest from 1. In parentheses the standard error."


def by_vehicle(board: Leaderboard, variant: str, heading: str, column: str) -> Table:
    """Return a column of the window rows with standard errors: a line per observer and window, a column per vehicle."""
    names = [f"f{i + 1}" for i in range(len(board.samples[0].scene.vehicles))]
    table = number_table([heading, "window"], names, gap=0)
    for name in board.ranked:
        for n, window in enumerate(board.windows):
            cells = [_cell(row, column) for row in board.windows_in(variant, name, window)]
            table.add_row(short_name(name) if n == 0 else "", window.name, *_or_failed(board, variant, name, cells))
    return table


def summary(board: Leaderboard, variant: str) -> Table:
    """Return, per observer and window, the median and the worst vehicle: RMSE, its ratio to the bound, and ANEES."""
    headings = ["RMSE [m]\nmedian", "\nworst", "ratio\nmedian", "\nworst", "\nof", "ANEES\nmedian", "\nworst", "\nof"]
    table = number_table(["by window", "window"], headings, gap=0)
    for name in board.ranked:
        for n, window in enumerate(board.windows):
            rows = board.windows_in(variant, name, window)
            error, ratio, anees = (
                spread(rows, column) for column in ("position_rmse_m", "ratio_to_bound_ancestors", "anees")
            )
            cells = [
                number(error.median, 2),
                _worst_window(error),
                number(ratio.median, 3),
                _worst_window(ratio),
                _who(ratio),
            ]
            cells += [number(anees.median, 2), _worst_window(anees), _who(anees)]
            table.add_row(short_name(name) if n == 0 else "", window.name, *_or_failed(board, variant, name, cells))
    return table


def _or_failed(board: Leaderboard, variant: str, name: str, cells: list[str]) -> list[str]:
    failed = any(row.failure for row in board.rows_in(variant, name))
    return [FAILED] * len(cells) if failed else cells


def _cell(row: WindowRow, column: str) -> str:
    return compact(getattr(row, column), getattr(row, ERRORS[column]))


def _worst_window(found: Spread) -> str:
    return compact(found.worst, found.error)


def _who(found: Spread) -> str:
    return found.vehicle.replace("vehicle_", "f")


WIDTH = 80
WIDE = 100  # without a terminal: vehicles have columns of their own
MOST_COLUMNS = 5  # vehicles shown one by one; more are summed up as mean and worst


def everything(board: Leaderboard, width: int = WIDTH) -> Iterator[Table | str]:
    """Yield errors, ratios, quality and windows of each variant, of faults one only; then variants and failures.

    `width`: characters that fit on a line.
    """
    variants = list(board.variants)
    for variant in variants[:1] if all(name in VARIANTS for name in variants) else variants:
        yield f"\n{board.title}, {variant}"
        yield error_table(board, variant)
        if len(board.seeds) > 1:
            yield "0.0123(4): 0.0123 with a standard error of 0.0004 over the seeds."
        if board.bounds_in(variant):
            yield ""
            yield ratio_table(board, variant)
        yield ""
        yield quality_table(board, variant)
        if line := honest_line(board.rows):
            yield line
        yield from window_tables(board, variant, width)
    if set(variants) <= set(Robots.named):
        yield f"\n{Robots.friendly}"
    if len(variants) > 1:
        yield ""
        yield variant_table(board, "mean RMSE [m]", "rmse", variants)
        if NOMINAL in variants:
            yield ""
            yield variant_table(board, "RMSE / nominal", "degradation", [v for v in variants if v != NOMINAL])
    yield from failures(board.rows)


def error_table(board: Leaderboard, variant: str) -> Table:
    """Return position RMSE in m of one variant per vehicle, and their mean, the bounds first."""
    bounds, few = board.bounds_in(variant), _few(board)
    table = number_table(["position RMSE [m]"], _headings(board, "mean"), gap=0)
    for column, values in bounds.items():
        average = sum(values) / len(values)
        shown = [*values, average] if few else [average, max(values)]
        table.add_row(BOUNDS[column], *(number(value, 3) for value in shown))
    for name in board.ranked:
        own = board.rows_in(variant, name)
        mean = in_parentheses(*board.totals[variant, name].rmse)
        cells = [in_parentheses(row.position_rmse_m, row.position_rmse_se_m) for row in (own if few else [_worst(own)])]
        _add(table, name, own, [*cells, mean] if few else [mean, *cells])
    return table


def ratio_table(board: Leaderboard, variant: str) -> Table:
    """Return position RMSE over the ancestors' bound per vehicle, and the worst one over the joint bound."""
    few = _few(board)
    table = number_table(["RMSE / bound\n(ancestors)"], _headings(board, "x joint\nworst"), gap=0)
    for name in board.ranked:
        own = board.rows_in(variant, name)
        joint, shown = _worst(own, "ratio_to_bound"), own if few else [_worst(own, "ratio_to_bound_ancestors")]
        cells = [] if few else [number(mean_of(own, "ratio_to_bound_ancestors"), 3)]
        cells += [in_parentheses(row.ratio_to_bound_ancestors, row.ratio_to_bound_ancestors_se) for row in shown]
        _add(table, name, own, [*cells, in_parentheses(joint.ratio_to_bound, joint.ratio_to_bound_se)])
    return table


def honest_line(rows: Sequence[Row]) -> str:
    """Return the range of the ANEES of a consistent filter; empty without any covariance."""
    known = (f"{row.anees_low:.2f} to {row.anees_high:.2f}" for row in rows if np.isfinite(row.anees_low))
    return next((f"ANEES of a consistent filter: 1 ({ends} at 95 % of instants)." for ends in known), "")


def quality_table(board: Leaderboard, variant: str) -> Table:
    """Return, of one variant over all vehicles: shares that settle, consistency (1: consistent) and costs."""
    headings = ["settled", "converged", "diverged", "ANEES\nbest", "ANEES\nworst", "NIS", "sent\nB/s", "us"]
    table = number_table(["observer"], headings, gap=0)
    for name in board.ranked:
        own = board.rows_in(variant, name)
        anees, nis = (
            [value for row in own if np.isfinite(value := getattr(row, column))] for column in ("anees", "nis")
        )
        shares = ("settled_fraction", "converged_fraction", "diverged_fraction")
        cells = [f"{100 * mean_of(own, column):.0f}%" for column in shares]
        top = _worst([row for row in own if np.isfinite(row.anees)], "anees") if anees else None
        cells += [number(min(anees), 2), compact(top.anees, top.anees_se)] if top else ["-", "-"]
        cells += [number(float(np.mean(nis)), 2) if nis else "-"]
        cells += [f"{mean_of(own, column):.0f}" for column in ("bytes_per_s", "us_per_update")]
        _add(table, name, own, cells)
    return table


def variant_table(board: Leaderboard, heading: str, column: str, variants: Sequence[str]) -> Table:
    """Return a column of the totals, over all vehicles, of every observer in some variants."""
    table = number_table([heading], ["\n".join(name.replace("+", "_+").split("_")) for name in variants], gap=0)
    for name in board.ranked:
        measured = [getattr(board.totals[variant, name], column) for variant in variants]
        failed = [column == "rmse" and np.isnan(one.value) for one in measured]
        cells = [FAILED if bad else in_parentheses(*one) for bad, one in zip(failed, measured, strict=True)]
        table.add_row(short_name(name), *cells)
    return table


def failures(rows: Sequence[Row]) -> list[str]:
    """Return one line per observer that failed and way in which it did, with the variants."""
    failed: dict[tuple[str, str], dict[str, None]] = {}
    for row in rows:
        if row.failure:
            failed.setdefault((row.observer, row.failure), {})[row.variant] = None
    return [f"{observer} ({', '.join(variants)}): failed {why}" for (observer, why), variants in failed.items()]


def _few(board: Leaderboard) -> bool:
    return len(board.samples[0].scene.vehicles) <= MOST_COLUMNS


def _headings(board: Leaderboard, last: str) -> list[str]:
    """Return one heading per vehicle and another one, or those of what sums up many vehicles."""
    if not _few(board):
        return ["mean", "worst"] if last == "mean" else ["mean", "worst", last]
    return [*(f"f{i + 1}" for i in range(len(board.samples[0].scene.vehicles))), last]


def _add(table: Table, name: str, rows: Sequence[Row], cells: Sequence[str]) -> None:
    failed = any(row.failure for row in rows)
    table.add_row(short_name(name), *([FAILED] * len(cells) if failed else cells))


def _worst(rows: Sequence[Row], column: str = "position_rmse_m") -> Row:
    return max(rows, key=lambda row: getattr(row, column))


def csv_text(rows: Sequence[Row] | Sequence[Draw] | Sequence[WindowRow]) -> str:
    """Return rows as CSV; figures that do not exist are empty."""
    table = [jsonable(row) for row in rows]
    text = StringIO()
    writer = csv.DictWriter(text, fieldnames=list(table[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(table)
    return text.getvalue()


def latex(board: Leaderboard, variant: str) -> str:
    """Return position RMSE per vehicle in m with standard errors as a LaTeX table.

    Five vehicles fit a column of 3.5 in.
    """
    vehicles = [f"f{i + 1}" for i in range(len(board.samples[0].scene.vehicles))]
    bounds = [[BOUNDS[c], *(number(v, 3) for v in values)] for c, values in board.bounds_in(variant).items()]
    observers = [[_latex_name(name), *map(_latex_cell, board.rows_in(variant, name))] for name in board.ranked]
    return "\n".join(
        [
            f"% {board.title}, {variant}: position RMSE in m",
            "% 0.0123(4) is 0.0123 with a standard error of 0.0004 over the seeds. Needs booktabs.",
            r"\begingroup\footnotesize\setlength{\tabcolsep}{3pt}%",
            rf"\begin{{tabular}}{{@{{}}l{'r' * len(vehicles)}@{{}}}}",
            r"\toprule",
            _latex_line(["", *vehicles]),
            r"\midrule",
            *map(_latex_line, bounds),
            *([r"\midrule"] if bounds else []),
            *map(_latex_line, observers),
            r"\bottomrule",
            r"\end{tabular}\endgroup",
            "",
        ]
    )


def _latex_line(cells: Sequence[str]) -> str:
    return " & ".join(cells) + r" \\"


def _escaped(text: str) -> str:
    """Return a text in which LaTeX's special characters stand for themselves."""
    return re.sub(r"([&%$#_{}])", r"\\\1", text.replace("\\", "/"))


def _latex_name(name: str) -> str:
    lines = [_escaped(line) for line in short_name(name).splitlines()]
    stacked = r"\\".join(lines)
    return stacked if len(lines) == 1 else rf"\shortstack[l]{{{stacked}}}"


def _latex_cell(row: Row) -> str:
    return FAILED if row.failure else compact(row.position_rmse_m, row.position_rmse_se_m)
