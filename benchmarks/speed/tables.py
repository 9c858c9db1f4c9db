"""Measurements as tables that fit a terminal."""

from __future__ import annotations

from dataclasses import dataclass
from textwrap import wrap

from benchmarks.speed.cases import COOPENV
from benchmarks.speed.coopenv_cases import BATCH, SINGLE
from benchmarks.speed.growth import Growth
from benchmarks.speed.measure import Result
from benchmarks.speed.peer_cases import VMAS
from benchmarks.speed.startup import Startup
from coopenv.report.table import Table

CASE_WIDTH = 24
"""Columns of a case's name; the longest is highway-env's."""
REASON_LINES = 4


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
    """Return rates per second of every case."""
    table = Table.of_texts(["case"], ["worlds", "cores", "type", "env\nsteps/s", "agent\nsteps/s", "vehicle\nticks/s"])
    silent: set[str] = set()
    for result in results:
        case = result.case
        if result.problem:
            if case.name not in silent:
                reason = wrap(result.problem, CASE_WIDTH - 2, max_lines=REASON_LINES, placeholder=" ...")
                table.add("\n  ".join([case.name, *reason]), *["-"] * 6)
            silent.add(case.name)
            continue
        rates = (result.env_steps_per_s, result.agent_steps_per_s, result.vehicle_ticks_per_s)
        table.add(case.name, str(case.worlds), str(case.threads), short(case.dtype), *map(count, rates))
    return table


@dataclass(frozen=True)
class Ratio:
    """coopenv's rates over a peer's, like with like: as many worlds, float32."""

    peer: str
    worlds: int
    ours: str
    threads: int
    """Threads of coopenv; peers have one."""
    env_steps: float
    agent_steps: float
    vehicle_ticks: float
    counted_for_peer: str


def ratios(results: list[Result]) -> list[Ratio]:
    """Return a ratio for every peer and every number of threads that coopenv was measured with."""
    measured = [r for r in results if not r.problem]
    return [
        Ratio(
            peer.case.name,
            peer.case.worlds,
            ours.case.name,
            ours.case.threads,
            ours.env_steps_per_s / peer.env_steps_per_s,
            ours.agent_steps_per_s / peer.agent_steps_per_s,
            ours.vehicle_ticks_per_s / peer.vehicle_ticks_per_s,
            peer.case.tick,
        )
        for peer in measured
        if peer.case.library != COOPENV.name
        for ours in measured
        if _comparable(ours, peer)
    ]


def _comparable(ours: Result, peer: Result) -> bool:
    """Compare batches with batches, and one world with dictionaries or tuples of agents with its like."""
    case = ours.case
    interface = BATCH if peer.case.library == VMAS.name else SINGLE
    return (
        case.library == COOPENV.name
        and case.name == interface
        and case.worlds == peer.case.worlds
        and case.dtype == "float32"
    )


def ratio_table(found: list[Ratio]) -> Table:
    """Return how many times a peer's rates coopenv's are, per number of threads."""
    table = Table.of_texts(
        ["peer (1 core)", "against"], ["worlds", "cores", "env\nsteps", "agent\nsteps", "vehicle\nticks"]
    )
    for r in found:
        rates = (r.env_steps, r.agent_steps, r.vehicle_ticks)
        table.add(r.peer, r.ours, str(r.worlds), str(r.threads), *map(times, rates))
    return table


def memory_table(results: list[Result]) -> Table:
    """Return the memory per world of each case's largest batch, one thread."""
    table = Table.of_texts(["case"], ["worlds", "type", "arrays\nKiB/world", "resident\nKiB/world"])
    largest: dict[tuple[str, str], Result] = {}
    for result in results:
        case = result.case
        if result.problem or case.threads > 1:
            continue
        held = largest.get((case.name, case.dtype))
        if held is None or held.case.worlds < case.worlds:
            largest[case.name, case.dtype] = result
    for (name, dtype), result in largest.items():
        row = result.row()
        table.add(
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
    table = Table.of_texts(
        ["library"],
        ["import", "first step f32,\nempty cache", "first step f64,\nempty cache", "f32,\ncached", "f64,\ncached"],
    )
    for name, seconds in startup.imports.items():
        found = [
            kind.get(dtype) if name == "coopenv" else None
            for kind in (startup.compiling, startup.cached)
            for dtype in ("float32", "float64")
        ]
        table.add(name, f"{seconds:.2f} s", *("-" if s is None else f"{s:.2f} s" for s in found))
    return table


def growth_table(found: list[Growth]) -> Table:
    """Return how the CPU time of a step of all worlds grows: cost ~ size ^ exponent."""
    table = Table.of_texts(
        ["what grows"],
        ["from", "to", "step at\nfirst [ms]", "step at\nlast [ms]", "exponent\n(all)", "exponent\n(large)"],
        gap=0,
    )
    for g in found:
        ends = (f"{1e3 * cost:.3g}" for cost in (g.costs[0], g.costs[-1]))
        exponents = (f"{law.exponent:.2f}" for law in (g.overall, g.large))
        table.add(g.sweep.label, f"{g.sizes[0]:,}", f"{g.sizes[-1]:,}", *ends, *exponents)
    return table
