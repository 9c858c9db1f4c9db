"""Measurements as tables that fit a terminal."""

from __future__ import annotations

from rich import box
from rich.table import Table

from coopenv.bench.agents import Score
from coopenv.bench.speed import Speed


def _table(*columns: tuple[str, str]) -> Table:
    table = Table(box=box.HORIZONTALS, padding=(0, 1, 0, 0), pad_edge=False, show_edge=False)
    for name, justify in columns:
        table.add_column(name, justify="left" if justify == "left" else "right", no_wrap=justify == "left")
    return table


def count(value: float) -> str:
    """Return a rate with three digits and a unit prefix: 1.23 M, 45.6 k."""
    for factor, prefix in ((1e6, " M"), (1e3, " k")):
        if value >= factor:
            return f"{value / factor:.3g}{prefix}"
    return f"{value:.3g}"


def speed_table(results: list[Speed]) -> Table:
    """Return rates per second of every case."""
    table = _table(
        ("case", "left"),
        ("worlds", ""),
        ("cores", ""),
        ("type", ""),
        ("env\nsteps/s", ""),
        ("agent\nsteps/s", ""),
        ("vehicle\nticks/s", ""),
    )
    for r in results:
        rates = (r.env_steps_per_s, r.agent_steps_per_s, r.vehicle_ticks_per_s)
        table.add_row(
            r.case.name, str(r.case.worlds), str(r.case.threads), r.case.dtype.replace("loat", ""), *map(count, rates)
        )
    return table


def score_table(rows: list[tuple[str, str, Score]]) -> Table:
    """Return one row per driver and environment."""
    table = _table(
        ("agent", "left"),
        ("environment", "left"),
        ("runs", ""),
        ("arrived", ""),
        ("collided", ""),
        ("out of\ntime", ""),
        ("return", ""),
        ("median\nerr [m]", ""),
        ("95 %\nerr [m]", ""),
    )
    for agent, name, s in rows:
        table.add_row(
            agent,
            name,
            str(s.episodes),
            *(f"{100 * share:.0f} %" for share in (s.arrived, s.collided, s.under_way)),
            f"{s.mean_return:.1f}±{s.std_return:.1f}",
            f"{s.median_position_error_m:.3f}",
            f"{s.p95_position_error_m:.3f}",
        )
    return table
