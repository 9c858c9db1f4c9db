"""Stretches of a run as tables for a terminal: by vehicle where there are few, or else the middle one and the worst."""

from collections.abc import Iterator

from rich.table import Table

from coopenv.base.format import number
from coopenv.bench.observers.leaderboard import Leaderboard
from coopenv.bench.observers.windows import ERRORS, Spread, WindowRow, spread
from coopenv.bench.observers.wording import FAILED, compact, short_name
from coopenv.runs.table import number_table

MOST_OBSERVERS = 4  # of whom every vehicle is shown
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
            table.add_row(short_name(name) if n == 0 else "", window.name, *_told(board, variant, name, cells))
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
            cells = [number(error.median, 2), _worst(error), number(ratio.median, 3), _worst(ratio), _who(ratio)]
            cells += [number(anees.median, 2), _worst(anees), _who(anees)]
            table.add_row(short_name(name) if n == 0 else "", window.name, *_told(board, variant, name, cells))
    return table


def _told(board: Leaderboard, variant: str, name: str, cells: list[str]) -> list[str]:
    failed = any(row.failure for row in board.rows_in(variant, name))
    return [FAILED] * len(cells) if failed else cells


def _cell(row: WindowRow, column: str) -> str:
    return compact(getattr(row, column), getattr(row, ERRORS[column]))


def _worst(found: Spread) -> str:
    return compact(found.worst, found.error)


def _who(found: Spread) -> str:
    return found.vehicle.replace("vehicle_", "f")
