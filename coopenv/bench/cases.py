"""What is measured: cases of coopenv, as plain data that a worker process can be told to build."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from coopenv.scenario import Scenario
from coopenv.world.embedded import ROBUST
from coopenv.world.launch import default_threads

SINGLE, BATCH = "ParallelEnv", "make_vec"
BATCHES = (1, 32, 1024, 8192)
QUICK_BATCHES = (1, 32, 1024)
ROBUST_BATCH = 1024
LONGEST_BATCH = 1 << 20
"""Worlds; enough for `default_threads` to return every core that may be used."""


@dataclass(frozen=True)
class Library:
    """Something that is measured in a process of its own."""

    name: str
    module: str
    """What a user imports."""
    build: str
    """module:function that makes a `Built` of a `Case`."""
    distributions: tuple[str, ...]
    """Whose versions matter."""


@dataclass(frozen=True)
class Case:
    """One thing to measure."""

    name: str
    library: str
    worlds: int
    vehicles: int
    """Agents that are given an action."""
    threads: int = 1
    dtype: str = "float32"
    infos: bool = True
    """False: the same, but the environment makes no infos."""
    tick: str = "camera ticks"
    """What is counted as vehicle ticks."""
    options: dict[str, Any] = field(default_factory=dict)
    """Whatever the library's builder wants to know."""


COOPENV = Library("coopenv", "coopenv", "coopenv.bench.own:build", ("coopenv", "warp-lang", "numpy"))


def all_threads() -> int:
    """Return the threads that a large batch is split over when nobody says otherwise."""
    return default_threads(LONGEST_BATCH, "cpu")


def own_cases(
    environment: str, scenario: Scenario, overrides: Mapping[str, Any] | None = None, quick: bool = False
) -> list[Case]:
    """Return coopenv's cases: one world, batches, precisions, threads, with and without infos, the robust observer.

    Visibility is sensed, unless `overrides` set `topology.mode`; where the file says otherwise, two cases follow that
    are as the file says.
    """
    given = dict(overrides or {})
    sensed = {"topology.mode": "sensed", **given}
    vehicles = len(scenario.vehicles)

    def case(name: str, worlds: int, threads: int, dtype: str, infos: bool, changes: dict[str, Any]) -> Case:
        options = {"environment": environment, "overrides": changes}
        return Case(name, COOPENV.name, worlds, vehicles, threads, dtype, infos, options=options)

    dtypes = ("float32",) if quick else ("float32", "float64")
    cases = [case(SINGLE, 1, 1, dtype, infos, sensed) for dtype in dtypes for infos in (True, False)]
    for worlds in QUICK_BATCHES if quick else BATCHES:
        for threads in sorted({1, min(worlds, all_threads())}):
            cases += [case(BATCH, worlds, threads, dtype, infos, sensed) for dtype in dtypes for infos in (True, False)]
    if not quick and scenario.observer.name != ROBUST and "observer.name" not in given:
        robust = {**sensed, "observer.name": ROBUST}
        for threads in sorted({1, all_threads()}):
            cases.append(case(f"{BATCH}, {ROBUST}", ROBUST_BATCH, threads, "float32", True, robust))
    if scenario.topology.mode != "sensed" and "topology.mode" not in given:
        label = f"{{}}, {scenario.topology.mode}"
        cases.append(case(label.format(SINGLE), 1, 1, "float32", True, given))
        cases.append(case(label.format(BATCH), 1024, all_threads(), "float32", True, given))
    return cases
