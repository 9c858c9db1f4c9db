"""The leaderboard of observers as tables that fit a terminal."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from rich import box
from rich.table import Table

from coopenv.bench.observers import Row

MOST_COLUMNS = 6
"""Vehicles shown one by one; more are summed up as mean and worst."""


def _table(first: str, headings: Sequence[str]) -> Table:
    table = Table(box=box.HORIZONTALS, padding=(0, 1, 0, 0), pad_edge=False, show_edge=False)
    table.add_column(first, no_wrap=True)
    for heading in headings:
        table.add_column(heading, justify="right", no_wrap=True)
    return table


def _by_observer(rows: Sequence[Row]) -> dict[str, list[Row]]:
    return {name: [r for r in rows if r.observer == name] for name in dict.fromkeys(r.observer for r in rows)}


def error_table(rows: Sequence[Row]) -> Table:
    """Return position RMSE per vehicle in m, the bound first, then a row per observer."""
    vehicles = len({row.vehicle for row in rows})
    few = vehicles <= MOST_COLUMNS
    headings = [f"f{i + 1}" for i in range(vehicles)] if few else ["mean", "worst"]
    table = _table("position RMSE [m]", headings)
    table.add_row("bound (joint)", *_errors([row.bound_m for row in rows[:vehicles]], few))
    for name, own in _by_observer(rows).items():
        failed = any(row.failure for row in own)
        table.add_row(
            name, *(["failed"] * len(headings) if failed else _errors([row.position_rmse_m for row in own], few))
        )
    return table


def quality_table(rows: Sequence[Row]) -> Table:
    """Return settled share, consistency (1 is honest) and costs of every observer, over all its vehicles."""
    headings = ["settled", "ANEES/6\nbest", "ANEES/6\nworst", "sent\nB/s", "us per\nupdate"]
    table = _table("observer", headings)
    for name, own in _by_observer(rows).items():
        if any(row.failure for row in own):
            continue
        anees = [row.anees for row in own if np.isfinite(row.anees)]
        table.add_row(
            name,
            f"{100 * np.mean([row.settled_fraction for row in own]):.0f} %",
            *((f"{min(anees):.2g}", f"{max(anees):.2g}") if anees else ("-", "-")),
            f"{np.mean([row.bytes_per_s for row in own]):.0f}",
            f"{np.mean([row.us_per_update for row in own]):.0f}",
        )
    return table


def failures(rows: Sequence[Row]) -> list[str]:
    """Return one line per observer that failed."""
    return [f"{name}: {why}" for name, why in {row.observer: row.failure for row in rows if row.failure}.items()]


def _errors(values: Sequence[float], few: bool) -> list[str]:
    shown = list(values) if few else [float(np.mean(values)), float(np.max(values))]
    return [f"{value:.4f}" if value < 1.0 else f"{value:.3g}" for value in shown]
