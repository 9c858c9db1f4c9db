"""Tables of any figures fit 80 columns; pictures are drawn of any results."""

from __future__ import annotations

from io import StringIO
from pathlib import Path

import pytest
from rich.console import Console
from rich.table import Table

import coopenv
from benchmarks.speed.cases import Case
from benchmarks.speed.coopenv_cases import own_cases
from benchmarks.speed.figures import draw_growth, draw_speed
from benchmarks.speed.growth import Growth, PowerLaw, sweeps
from benchmarks.speed.measure import Result
from benchmarks.speed.peer_cases import peer_cases
from benchmarks.speed.startup import Startup
from benchmarks.speed.tables import (
    growth_table,
    memory_table,
    ratio_table,
    ratios,
    speed_table,
    startup_table,
)

WIDTH = 80


def text(table: Table) -> str:
    out = StringIO()
    Console(file=out, width=WIDTH, markup=False, highlight=False).print(table)
    return out.getvalue()


def measured(case: Case, rate: float = 123456.0) -> Result:
    """A case that makes `rate` environment steps per second."""
    built = {"build_s": 0.1, "first_step_s": 0.1, "rss_bytes": 150e9 * case.worlds, "array_bytes": 150e9 * case.worlds}
    rounds = [{"steps": rate, "ticks": 30 * rate, "wall_s": case.worlds, "cpu_s": case.worlds}]
    return Result(case, built, rounds)


@pytest.fixture
def results() -> list[Result]:
    cases = own_cases("busy_intersection", coopenv.load_scenario("busy_intersection"))
    return [measured(c, 9.994e6) for c in cases] + [measured(c, 0.01) for c in peer_cases()]


def test_cases_cover_what_is_promised() -> None:
    cases = own_cases("busy_intersection", coopenv.load_scenario("busy_intersection"))
    batches = [c for c in cases if c.name == "make_vec"]
    assert {c.worlds for c in batches} == {1, 32, 1024, 8192}
    assert {c.dtype for c in batches if c.worlds == 1024 and c.threads == 1} == {"float32", "float64"}
    assert all(c.options["overrides"] == {"topology.mode": "sensed"} for c in batches)
    given = own_cases("busy_intersection", coopenv.load_scenario("busy_intersection"), {"topology.mode": "fixed"})
    robust = [c for c in given if c.name == "make_vec, robust"]
    assert {c.threads for c in robust} == {1, max(c.threads for c in batches)}
    assert all(c.options["overrides"] == {"topology.mode": "fixed", "observer.name": "robust"} for c in robust)
    assert all(c.options["overrides"] == {"topology.mode": "fixed"} for c in given if c not in robust)
    assert [(c.name, c.worlds) for c in peer_cases()] == [
        ("highway-env intersection", 1),
        *(("VMAS navigation", n) for n in (1, 32, 1024)),
        *(("VMAS road_traffic", n) for n in (1, 32, 1024)),
        ("mpe2 simple_spread", 1),
    ]


def test_every_table_fits(results: list[Result]) -> None:
    law = PowerLaw(-10.234, 1.0)
    tables = [
        speed_table(results),
        ratio_table(ratios(results)),
        memory_table(results),
        startup_table(
            Startup({"highway-env": 123.456, "coopenv": 1.0}, *[dict.fromkeys(("float32", "float64"), 1e3)] * 2)
        ),
        growth_table([Growth(s, list(s.sizes), [1e-4] * (len(s.sizes) - 1) + [123.456], law, law) for s in sweeps()]),
    ]
    for table in tables:
        shown = text(table)
        assert max(len(line) for line in shown.splitlines()) <= WIDTH
        assert "…" not in shown


def test_what_is_missing_is_a_row(results: list[Result]) -> None:
    hint = "not installed: pip install vmas"
    gone = [Result(r.case, problem=hint) if r.case.library == "VMAS" else r for r in results]
    shown = text(speed_table(gone))
    assert shown.count("VMAS navigation") == 1
    assert "not installed: pip" in shown
    assert "install vmas" in shown
    endless = Result(peer_cases()[0], problem="failed: " + "a very long reason " * 50)
    assert max(len(line) for line in text(speed_table([endless])).splitlines()) <= WIDTH


def test_like_stands_against_like(results: list[Result]) -> None:
    found = ratios(results)
    assert {(r.ours, r.worlds) for r in found if r.peer.startswith("VMAS")} == {("make_vec", n) for n in (1, 32, 1024)}
    assert {(r.ours, r.threads) for r in found if r.peer.startswith(("highway", "mpe2"))} == {("ParallelEnv", 1)}
    first = found[0]
    assert first.env_steps == pytest.approx(9.994e8)
    assert first.agent_steps == pytest.approx(9.994e8 * 5 / 4)


def test_pictures(results: list[Result], tmp_path: Path) -> None:
    law = PowerLaw(1.0, 1e-3)
    found = [Growth(s, list(s.sizes), [1e-3 * n for n in s.sizes], law, law) for s in sweeps()]
    for path in (draw_speed(results, tmp_path / "speed.png"), draw_growth(found, tmp_path / "growth.png")):
        assert path.exists()
    only_one = [r for r in results if r.case.name == "ParallelEnv"][:1]
    assert draw_speed(only_one, tmp_path / "one.png").exists()
