"""One run: import times, rates of all cases, and growth; one process busy at a time."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.console import Console

from benchmarks.machine import machine
from benchmarks.speed import startup
from benchmarks.speed.cases import COOPENV
from benchmarks.speed.coopenv_cases import own_cases
from benchmarks.speed.growth import summarise, sweeps
from benchmarks.speed.measure import Result, measure, units_of_work
from benchmarks.speed.peer_cases import PEERS, install_hint, installed, peer_cases
from benchmarks.speed.report import Report
from benchmarks.speed.workers import Workers
from coopenv.base.errors import CoopenvError
from coopenv.base.installation import versions
from coopenv.runs.console import Progress
from coopenv.scenario import Scenario

IMPORTS = 3
"""Fresh processes per library, of whose import times the median counts."""


def measured(
    command: str,
    environment: str,
    scenario: Scenario,
    overrides: Mapping[str, Any],
    *,
    seconds: float,
    rounds: int,
    peers: bool,
    growth: bool,
    quick: bool,
    log: Console,
) -> Report:
    """Measure everything.

    Args:
        command: what measures the same again.
        environment: name or path of the scenario.
        scenario: the same, read, with the overrides.
        overrides: of the scenario.
        seconds: per case and round.
        rounds: of which medians are taken.
        peers: whether to measure other projects.
        growth: whether to grow vehicles, landmarks and worlds.
        quick: fewer cases, and nothing is compiled into an empty cache.
        log: for the progress.

    Raises:
        CoopenvError: coopenv itself cannot be stepped.
    """
    place = machine()
    present = {peer.name: peer for peer in PEERS if peers and installed(peer)}
    libraries = [COOPENV, *present.values()]
    wanted = peer_cases(quick) if peers else []
    cases = own_cases(environment, scenario, overrides, quick) + [case for case in wanted if case.library in present]
    grown = [(sweep, sweep.cases()) for sweep in sweeps(quick)] if growth else []
    imports, compiled = (1, ()) if quick else (IMPORTS, ("float32", "float64"))
    total = units_of_work(cases, rounds) + startup.units_of_work(libraries, compiled, imports)
    total += sum(units_of_work(found, rounds) for _, found in grown)
    with Progress(log, "starting", total) as progress:
        on_progress = progress.advance
        waits = startup.measure_startup(libraries, environment, dict(overrides), compiled, imports, on_progress)
        with Workers(libraries) as workers:
            results = measure(cases, workers, seconds, rounds, on_progress)
        laws = []
        for sweep, found in grown:
            with Workers(libraries) as workers:  # with the memory of the last ones free again
                laws.append(summarise(sweep, measure(found, workers, seconds, rounds, on_progress)))
    for result in (r for r in results if r.problem and r.case.library == COOPENV.name):
        raise CoopenvError(f"{result.case.name}, {result.case.worlds} worlds: {result.problem}")
    hints = {peer.name: install_hint(peer) for peer in PEERS}
    results += [Result(case, problem=hints[case.library]) for case in wanted if case.library not in present]
    packages = versions(*(name for library in libraries for name in library.distributions))
    laws_found = [law for law in laws if law is not None]
    return Report(command, environment, seconds, rounds, place, packages, results, waits, laws_found)
