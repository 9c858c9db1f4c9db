"""Measurements as tables that fit a terminal."""

from __future__ import annotations

from textwrap import wrap

from rich import box
from rich.table import Table

from coopenv.bench.agents import Score
from coopenv.bench.growth import Growth
from coopenv.bench.measure import Result
from coopenv.bench.ratios import Ratio
from coopenv.bench.startup import Startup

CASE_WIDTH = 24
"""Columns of a case's name; the longest is highway-env's."""
REASON_LINES = 4


def _table(*columns: tuple[str, str]) -> Table:
    table = Table(box=box.HORIZONTALS, padding=(0, 1, 0, 0), pad_edge=False, show_edge=False)
    for name, justify in columns:
        table.add_column(name, justify="left" if justify == "left" else "right", no_wrap=justify == "left")
    return table


def count(value: float) -> str:
    """Return a rate with three digits and a unit prefix: 1.23 M, 45.6 k."""
    for factor, prefix in ((1e9, " G"), (1e6, " M"), (1e3, " k")):
        if value >= 0.9995 * factor:
            return f"{value / factor:.3g}{prefix}"
    return f"{value:.3g}"


def times(ratio: float) -> str:
    """Return a ratio with two or three digits."""
    if ratio >= 1e4:
        return count(ratio)
    return f"{ratio:,.0f}" if ratio >= 100 else f"{ratio:.2g}"


def short(dtype: str) -> str:
    """Return f32 for float32."""
    return dtype.replace("loat", "")


def speed_table(results: list[Result]) -> Table:
    """Return rates per second of every case; cases without infos appear as the cost of infos of their twins."""
    table = _table(
        ("case", "left"),
        ("worlds", ""),
        ("cores", ""),
        ("type", ""),
        ("env\nsteps/s", ""),
        ("agent\nsteps/s", ""),
        ("vehicle\nticks/s", ""),
        ("infos\ncost", ""),
    )
    silent: set[str] = set()
    for result in (r for r in results if r.case.infos):
        case = result.case
        if result.problem:
            if case.name not in silent:
                reason = wrap(result.problem, CASE_WIDTH - 2, max_lines=REASON_LINES, placeholder=" ...")
                table.add_row("\n  ".join([case.name, *reason]), *["-"] * 7)
            silent.add(case.name)
            continue
        rates = (result.env_steps_per_s, result.agent_steps_per_s, result.vehicle_ticks_per_s)
        table.add_row(
            case.name,
            str(case.worlds),
            str(case.threads),
            short(case.dtype),
            *map(count, rates),
            _infos_cost(result, results),
        )
    return table


def _infos_cost(result: Result, results: list[Result]) -> str:
    twins = [r for r in results if not r.case.infos and not r.problem and _twins(r, result)]
    if not twins:
        return ""
    return f"{100 * (1 - result.env_steps_per_s / twins[0].env_steps_per_s):.0f} %"


def _twins(a: Result, b: Result) -> bool:
    def key(r: Result) -> tuple[object, ...]:
        return (r.case.library, r.case.name, r.case.worlds, r.case.threads, r.case.dtype)

    return key(a) == key(b)


def ratio_table(found: list[Ratio]) -> Table:
    """Return how many times a peer's rates coopenv's are, per number of threads."""
    table = _table(
        ("peer (1 core)", "left"),
        ("worlds", ""),
        ("against", "left"),
        ("cores", ""),
        ("env\nsteps", ""),
        ("agent\nsteps", ""),
        ("vehicle\nticks", ""),
    )
    for r in found:
        rates = (r.env_steps, r.agent_steps, r.vehicle_ticks)
        table.add_row(r.peer, str(r.worlds), r.ours, str(r.threads), *map(times, rates))
    return table


def memory_table(results: list[Result]) -> Table:
    """Return the memory per world of each case's largest batch, one thread, infos included."""
    table = _table(
        ("case", "left"), ("worlds", ""), ("type", ""), ("arrays\nKiB/world", ""), ("resident\nKiB/world", "")
    )
    largest: dict[tuple[str, str], Result] = {}
    for result in results:
        case = result.case
        if result.problem or not case.infos or case.threads > 1:
            continue
        held = largest.get((case.name, case.dtype))
        if held is None or held.case.worlds < case.worlds:
            largest[case.name, case.dtype] = result
    for (name, dtype), result in largest.items():
        row = result.row()
        table.add_row(
            name,
            str(result.case.worlds),
            short(dtype),
            *(_kibibytes(row[key]) for key in ("array_bytes_per_world", "rss_bytes_per_world")),
        )
    return table


def _kibibytes(size: float | None) -> str:
    return "-" if size is None else f"{size / 1024:,.1f}"


def startup_table(startup: Startup) -> Table:
    """Return seconds until the first step."""
    table = _table(
        ("library", "left"),
        ("import", ""),
        ("first step f32,\nempty cache", ""),
        ("first step f64,\nempty cache", ""),
        ("f32,\ncached", ""),
        ("f64,\ncached", ""),
    )
    for name, seconds in startup.imports.items():
        found = [
            kind.get(dtype) if name == "coopenv" else None
            for kind in (startup.compiling, startup.cached)
            for dtype in ("float32", "float64")
        ]
        table.add_row(name, f"{seconds:.2f} s", *("-" if s is None else f"{s:.2f} s" for s in found))
    return table


def growth_table(found: list[Growth]) -> Table:
    """Return how the time of a step of all worlds grows: cost ~ size ^ exponent."""
    table = _table(
        ("what grows", "left"),
        ("from", ""),
        ("to", ""),
        ("step at\nfirst [ms]", ""),
        ("step at\nlast [ms]", ""),
        ("exponent\n(all)", ""),
        ("exponent\n(large)", ""),
    )
    for g in found:
        ends = (f"{1e3 * cost:.3g}" for cost in (g.costs[0], g.costs[-1]))
        exponents = (f"{law.exponent:.2f}" for law in (g.overall, g.large))
        table.add_row(g.sweep.label, f"{g.sizes[0]:,}", f"{g.sizes[-1]:,}", *ends, *exponents)
    return table


def score_table(rows: list[tuple[str, str, Score]]) -> Table:
    """Return one row per driver and environment."""
    table = _table(
        ("agent", "left"),
        ("environment", "left"),
        ("runs", ""),
        ("arri-\nved", ""),
        ("colli-\nded", ""),
        ("out of\ntime", ""),
        ("return", ""),
        ("median\nerror", ""),
        ("95 %\nerror", ""),
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
