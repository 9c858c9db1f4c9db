"""The tables of a comparison of observers."""

import re
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from coopenv.base.format import in_parentheses, number, with_error
from coopenv.bench.observers.convergence import basin_failures, basin_table
from coopenv.bench.observers.faults import NOMINAL, VARIANTS
from coopenv.bench.observers.judge import TimeWindow
from coopenv.bench.observers.rows import (
    BOUNDS,
    ERRORS,
    Leaderboard,
    Measured,
    Row,
    WindowRow,
    spread,
    standard_error,
    verdict_on,
)
from coopenv.estimation.metrics import SETTLED, mean_or_nan
from coopenv.estimation.poses import Array
from coopenv.report.table import Table
from coopenv.sources.registry import kinds

FAILED = "failed"


def quality(board: Leaderboard, variant: str, observer: str) -> dict[str, Any]:
    """Return rows and total, shares in %, costs and NIS with standard errors, the worst figures, and rows by ANEES.

    Vehicles of one seed may depend on one another: errors are those of the means of each seed.
    """

    def each(name: str) -> Array:
        return np.array([sample.measured(name) for sample in board.groups[variant, observer]], float)

    def measured(values: Array) -> Measured:
        return Measured(float(values.mean()), standard_error(values))

    rows = board.rows_in(variant, observer)
    dof = each("nis_dof").sum(axis=1)
    return {
        "rows": rows,
        "total": board.totals[variant, observer],
        "settled": measured(100.0 * np.isfinite(each("settle_time")).mean(axis=1)),
        "diverged": measured(100.0 * each("diverged").mean(axis=1)),
        "sent": measured(each("bytes_per_s").mean(axis=1)),
        "time": measured(each("us_per_update").mean(axis=1)),
        "nis": measured(each("nis").sum(axis=1) / np.where(dof > 0, dof, np.nan)),
        "stated": sorted((row for row in rows if np.isfinite(row.anees)), key=lambda row: row.anees),
        "verdict": verdict_on(rows),
        "finding": rows[0].finding or "-",
        "worst": largest_error(rows),
        **{f"worst_{column}": spread(rows, column) for column in ("ratio_to_bound_ancestors", "anees")},
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
        f"mean position RMSE {_words(board.totals[first, names[0]].rmse)} m in the steady state, {best['verdict']}"
    ]
    if (ratio := best["worst_ratio_to_bound_ancestors"]).vehicle:
        lines[0] += f", {_words(Measured(*ratio[1:3]))} times the Cramér-Rao bound at worst ({ratio.vehicle})"
    if len(names) > 1:
        lines[0] += f"; {names[1]} follows with {_words(board.totals[first, names[1]].rmse)} m"
    always = [name for name in names if quality(board, first, name)["settled"].value == 100.0]
    winners = ", ".join(always) if always else "none"
    return [lines[0] + ".", f"Every vehicle settles below {SETTLED.text} in every seed with: {winners}."]


def _words(measured: Measured) -> str:
    value, error = with_error(*measured)
    return f"{value} ± {error}" if error else value


_NAMED = 16  # characters of an observer's name on one line


def short_name(name: str) -> str:
    """Return an observer's name, on two lines if it is long."""
    cut = name.rfind("_", 0, _NAMED) + 1 if len(name) > _NAMED else 0
    return f"{name[:cut]}\n{name[cut:]}" if cut else name


def compact(value: float, error: float) -> str:
    """Return a number with its standard error in parentheses; without it where so many digits would not fit."""
    return in_parentheses(value, error) if 1e-3 <= abs(value) < 1e4 else number(value, 2)


def mean_of(rows: Sequence[Row], column: str) -> float:
    """Return the mean of a column."""
    return float(np.mean([getattr(row, column) for row in rows]))


WIDTH = 80
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
            yield f"0.0123(4): 0.0123 with a standard error of 0.0004 over the {board.sampled}."
        if board.bounds_in(variant):
            yield ""
            yield ratio_table(board, variant)
        yield ""
        yield quality_table(board, variant)
        yield ""
        yield consistency_table(board, variant)
        if line := honest_line(board.rows):
            yield line
        if levels := level_table(board, variant):
            yield ""
            yield levels
        yield from window_tables(board, variant, width)
    yield from (f"\n{kind.caveat}" for kind in kinds().values() if set(variants) <= set(kind.variants))
    if board.sensor_sets:
        yield ""
        yield sensor_table(board)
        yield "ANEES: of the vehicle whose value is farthest from 1."
    if len(variants) > len(board.sensor_sets) + 1 or (len(variants) > 1 and not board.sensor_sets):
        yield ""
        yield variant_table(board, "mean RMSE [m]", "rmse", variants)
        if NOMINAL in variants:
            yield ""
            yield variant_table(board, "RMSE / nominal", "degradation", [v for v in variants if v != NOMINAL])
    if unknown := board.samples[0].scene.without_truth:
        yield f"\nNot judged, as no true poses are known: {', '.join(unknown)}."
    yield from failures(board.rows)
    if board.basins:
        yield ""
        yield basin_table(board.basins)
        yield from basin_failures(board.basins)


def _add_observers(
    table: Table,
    board: Leaderboard,
    variant: str,
    cells: Callable[[list[Any]], list[str]],
    windows: Sequence[TimeWindow | None] = (None,),
) -> Table:
    """Add a line per observer, the best first, and window (None: the rows of the leaderboard), and return the table."""
    for name in board.ranked:
        own = board.rows_in(variant, name)
        for n, window in enumerate(windows):
            found = cells(own if window is None else board.windows_in(variant, name, window))
            shown = [FAILED] * len(found) if any(row.failure for row in own) else found
            table.add(short_name(name) if n == 0 else "", *([window.name] if window else []), *shown)
    return table


def _cells(rows: Sequence[Row], column: str, few: bool) -> list[str]:
    """Return a column with its standard errors, of every vehicle or of the worst alone."""
    shown = rows if few else [max(rows, key=lambda row: float(getattr(row, column)))]
    return [in_parentheses(getattr(row, column), getattr(row, ERRORS[column])) for row in shown]


def _headings(board: Leaderboard) -> list[str]:
    """Return one heading per vehicle, the paper's where names are as there."""
    numbers = [re.fullmatch(r"vehicle_(\d+)", name) for name in board.vehicles]
    return [f"f{number[1] if number else i + 1}" for i, number in enumerate(numbers)]


def error_table(board: Leaderboard, variant: str) -> Table:
    """Return position RMSE in m of one variant per vehicle, and their mean, the bounds first."""
    few = len(board.vehicles) <= MOST_COLUMNS
    table = Table.of_texts(["position RMSE [m]"], [*_headings(board), "mean"] if few else ["mean", "worst"], gap=0)
    for column, values in board.bounds_in(variant).items():
        average = sum(values) / len(values)
        shown = [*values, average] if few else [average, max(values)]
        table.add(BOUNDS[column], *(number(value, 3) for value in shown))

    def cells(own: list[Row]) -> list[str]:
        mean, found = in_parentheses(*board.totals[variant, own[0].observer].rmse), _cells(own, "position_rmse_m", few)
        return [*found, mean] if few else [mean, *found]

    return _add_observers(table, board, variant, cells)


def ratio_table(board: Leaderboard, variant: str) -> Table:
    """Return position RMSE over the ancestors' bound per vehicle, and the worst one over the joint bound."""
    few, column = len(board.vehicles) <= MOST_COLUMNS, "ratio_to_bound_ancestors"
    headings = [*(_headings(board) if few else ["mean", "worst"]), "x joint\nworst"]

    def cells(own: list[Row]) -> list[str]:
        mean = [] if few else [number(mean_of(own, column), 3)]
        return [*mean, *_cells(own, column, few), *_cells(own, "ratio_to_bound", False)]

    return _add_observers(Table.of_texts(["RMSE / bound\n(ancestors)"], headings, gap=0), board, variant, cells)


def honest_line(rows: Sequence[Row]) -> str:
    """Return the range of the ANEES of a consistent filter; empty without any covariance."""
    known = (f"{row.anees_low:.2f} to {row.anees_high:.2f}" for row in rows if np.isfinite(row.anees_low))
    return next((f"ANEES of a consistent filter: 1 ({ends} at 95 % of instants)." for ends in known), "")


def quality_table(board: Leaderboard, variant: str) -> Table:
    """Return, of one variant over all vehicles: shares that settle, the largest error of a vehicle, costs."""
    headings = ["settled", "converged", "diverged", "worst after\nstart [m]", "sent\nB/s", "us"]

    def cells(own: list[Row]) -> list[str]:
        shares = ("settled_fraction", "converged_fraction", "diverged_fraction")
        return [
            *(f"{100 * mean_of(own, column):.0f}%" for column in shares),
            number(largest_error(own), 2),
            *(f"{mean_of(own, column):.0f}" for column in ("bytes_per_s", "us_per_update")),
        ]

    return _add_observers(Table.of_texts(["observer"], headings, gap=0), board, variant, cells)


def largest_error(rows: Sequence[Row]) -> float:
    """Return the largest error after the start of all vehicles, m; NaN where no vehicle has one."""
    return max((row.worst_after_start_m for row in rows if np.isfinite(row.worst_after_start_m)), default=np.nan)


def consistency_table(board: Leaderboard, variant: str) -> Table:
    """Return, of one variant over all vehicles: the verdict on their covariances, ANEES and NIS (1: consistent)."""
    headings = ["verdict", "ANEES\nlowest", "\nhighest", "\nof", "NIS", "finding"]

    def cells(own: list[Row]) -> list[str]:
        stated = sorted((row for row in own if np.isfinite(row.anees)), key=lambda row: row.anees)
        nis = [row.nis for row in own if np.isfinite(row.nis)]
        highest = [compact(stated[-1].anees, stated[-1].anees_se), _short(stated[-1].vehicle)] if stated else ["-", "-"]
        lowest = number(stated[0].anees, 2) if stated else "-"
        finding = own[0].finding.replace(", ", "\n") or "-"
        innovations = number(float(np.mean(nis)), 2) if nis else "-"
        return [verdict_on(own).replace(" ", "\n"), lowest, *highest, innovations, finding]

    return _add_observers(Table.of_texts(["consistency"], headings, gap=0), board, variant, cells)


def _short(vehicle: str) -> str:
    """Return the name of a vehicle, the paper's where it has one."""
    return vehicle.replace("vehicle_", "f")


LEVELS = {
    "level_exceeded": "exceeded\n[%]",
    "angle_level_exceeded": "angle\n[%]",
    "level_unknown": "unknown\n[%]",
    "level_over_e95": "level\n/ e95",
}
"""Measure of protection levels to its heading."""


def level_figures(board: Leaderboard, variant: str) -> dict[str, list[Measured]]:
    """Return the figures of `LEVELS` over all vehicles of every observer that states protection levels; shares in %."""
    found = {}
    for name, own in board.samples_in(variant).items():
        values = np.array([[sample.measured(column) for column in LEVELS] for sample in own])  # (S, 4, N)
        if np.isfinite(values[:, 0]).any():
            seeds = np.array([[mean_or_nan(of) for of in one] for one in values]) * [100.0, 100.0, 100.0, 1.0]
            found[name] = [Measured(float(mean_or_nan(of)), standard_error(of)) for of in seeds.T]
    return found


def level_table(board: Leaderboard, variant: str) -> Table:
    """Return, of one variant over all vehicles, how protection levels compare with errors; empty: none are stated."""
    table = Table.of_texts(["protection level"], [*LEVELS.values()], gap=0)
    for name, measured in level_figures(board, variant).items():
        table.add(short_name(name), *(compact(*one) if one.value else "0" for one in measured))
    return table


MOST_OBSERVERS = 4  # with a column per vehicle
NAMES, COLUMN = 26, 9  # characters on a line: of observer and window, and of each vehicle


def window_tables(board: Leaderboard, variant: str, width: int) -> Iterator[Table | str]:
    """Yield ratios and consistency of one variant by window; nothing where there is the steady state alone.

    `width`: characters that fit on a line. Vehicles have columns of their own where these fit, and else median and
    worst vehicle are shown.
    """
    if len(board.windows) < 2:
        return
    yield ""
    if NAMES + COLUMN * len(board.vehicles) > width or len(board.observers) > MOST_OBSERVERS:
        yield summary(board, variant)
        yield "Ratio to the ancestors' bound; worst ANEES: the farthest from 1. In parentheses the standard error."
        return
    bounded = ("RMSE / bound\n(ancestors)", "ratio_to_bound_ancestors")
    heading, column = bounded if board.bounds_in(variant) else ("position RMSE\n[m]", "position_rmse_m")
    yield by_vehicle(board, variant, heading, column)
    yield ""
    yield by_vehicle(board, variant, "ANEES", "anees")


def by_vehicle(board: Leaderboard, variant: str, heading: str, column: str) -> Table:
    """Return a column of the window rows with standard errors: a line per observer and window, a column per vehicle."""

    def cells(rows: list[WindowRow]) -> list[str]:
        return [compact(getattr(row, column), getattr(row, ERRORS[column])) for row in rows]

    table = Table.of_texts([heading, "window"], _headings(board), gap=0)
    return _add_observers(table, board, variant, cells, board.windows)


def summary(board: Leaderboard, variant: str) -> Table:
    """Return, per observer and window, the median and the worst vehicle: RMSE, its ratio to the bound, and ANEES."""
    headings = ["RMSE [m]\nmedian", "\nworst", "ratio\nmedian", "\nworst", "\nof", "ANEES\nmedian", "\nworst", "\nof"]

    def cells(rows: list[WindowRow]) -> list[str]:
        return [
            *_spread(rows, "position_rmse_m", 2)[:2],
            *_spread(rows, "ratio_to_bound_ancestors", 3),
            *_spread(rows, "anees", 2),
        ]

    table = Table.of_texts(["by window", "window"], headings, gap=0)
    return _add_observers(table, board, variant, cells, board.windows)


def _spread(rows: Sequence[Row] | Sequence[WindowRow], column: str, digits: int) -> list[str]:
    """Return the median vehicle's figure, the worst one's, and which vehicle that is."""
    found = spread(rows, column)
    return [number(found.median, digits), compact(found.worst, found.error), _short(found.vehicle)]


def variant_table(board: Leaderboard, heading: str, column: str, variants: Sequence[str]) -> Table:
    """Return a column of the totals, over all vehicles, of every observer in some variants."""
    table = Table.of_texts([heading], ["\n".join(name.replace("+", "_+").split("_")) for name in variants], gap=0)
    for name in board.ranked:
        measured = [getattr(board.totals[variant, name], column) for variant in variants]
        failed = [column == "rmse" and np.isnan(one.value) for one in measured]
        cells = [FAILED if bad else in_parentheses(*one) for bad, one in zip(failed, measured, strict=True)]
        table.add(short_name(name), *cells)
    return table


def sensor_table(board: Leaderboard) -> Table:
    """Return position RMSE in m and the worst ANEES of every set of sensors and observer, each set below its bound."""
    few = len(board.vehicles) <= MOST_COLUMNS
    headings = [*(_headings(board) if few else ["worst"]), "mean", "ANEES"]
    table = Table.of_texts(["sensors", "position RMSE [m]"], headings, gap=0)
    for variant in board.sensor_sets:
        shown = variant
        if values := board.bounds_in(variant).get("bound_ancestors_m"):
            own = [*(values if few else [max(values)]), sum(values) / len(values)]
            table.add(shown, BOUNDS["bound_ancestors_m"], *(number(value, 3) for value in own), "")
            shown = ""
        for name in board.ranked:
            rows = board.rows_in(variant, name)
            mean = in_parentheses(*board.totals[variant, name].rmse)
            found = [*_cells(rows, "position_rmse_m", few), mean, _spread(rows, "anees", 2)[1]]
            failed = any(row.failure for row in rows)
            table.add(shown, name, *([FAILED] * len(found) if failed else found))
            shown = ""
    return table


def failures(rows: Sequence[Row]) -> list[str]:
    """Return one line per observer that failed and way in which it did, with the variants."""
    failed: dict[tuple[str, str], dict[str, None]] = {}
    for row in rows:
        if row.failure:
            failed.setdefault((row.observer, row.failure), {})[row.variant] = None
    return [f"{observer} ({', '.join(variants)}): failed {why}" for (observer, why), variants in failed.items()]


def latex(board: Leaderboard, variant: str) -> str:
    """Return position RMSE per vehicle in m with standard errors, largest errors and verdicts as a LaTeX table.

    Five vehicles fit a column of 3.5 in.
    """
    table = Table.of_texts([""], _headings(board))
    for column, values in board.bounds_in(variant).items():
        table.add(BOUNDS[column], *(number(value, 3) for value in values))
    table.rules.append(len(table))
    rows = {name: board.rows_in(variant, name) for name in board.ranked}
    for name, own in rows.items():
        cells = (FAILED if row.failure else compact(row.position_rmse_m, row.position_rmse_se_m) for row in own)
        table.add(short_name(name), *cells)
    table.rules.append(len(table))
    table.add("worst after start", "verdict")
    for name, own in rows.items():
        failed = any(row.failure for row in own)
        table.add(short_name(name), FAILED if failed else f"{number(largest_error(own), 2)} m, {verdict_on(own)}")
    return table.latex(
        f"{board.title}, {variant}: position RMSE in m",
        f"0.0123(4) is 0.0123 with a standard error of 0.0004 over the {board.sampled}. Needs booktabs.",
    )
