"""Measuring through a real worker process; scenarios of any size and exponents; tables and pictures of any figures."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import coopenv
from benchmarks.speed import run
from benchmarks.speed.__main__ import main
from benchmarks.speed.cases import Case
from benchmarks.speed.coopenv_cases import own_cases
from benchmarks.speed.growth import MOST_NEARBY, Sweep, fit_power_law, growth_scenario, summarise
from benchmarks.speed.measure import Result, measure, units_of_work
from benchmarks.speed.peer_cases import HIGHWAY, peer_cases
from benchmarks.speed.report import BUSY
from benchmarks.speed.tables import (
    ratios,
)
from benchmarks.speed.workers import WorkerError, Workers
from coopenv.api.engine import Engine
from coopenv.scenario.schema import neighbour_sets
from tests.helpers.fake_library import FAKE, SHARE, STEP, fake_case


@pytest.fixture
def workers() -> Iterator[Workers]:
    with Workers([FAKE]) as workers:
        yield workers


def test_rates_are_of_the_work_done(workers: Workers) -> None:
    progress: list[str] = []
    cases = [fake_case(), fake_case("other", worlds=1)]
    results = measure(cases, workers, seconds=0.05, repeats=3, on_progress=progress.append)
    assert len(progress) == units_of_work(cases, 3)
    assert progress[0] == "building fake x 3"
    for result, worlds in zip(results, (3, 1), strict=True):
        assert len(result.rounds) == 3
        assert result.env_steps_per_s == pytest.approx(worlds / STEP)
        assert result.agent_steps_per_s == pytest.approx(2 * result.env_steps_per_s)
        assert result.vehicle_ticks_per_s == pytest.approx(5 * result.env_steps_per_s)
        assert result.cores_used == pytest.approx(SHARE)


def test_a_case_that_fails_leaves_the_others_alone(workers: Workers) -> None:
    bad, good = measure([fake_case(import_error=True), fake_case()], workers, 0.01, 2)
    assert bad.problem == "failed: ImportError: no module of that name"
    assert not bad.rounds
    assert not good.problem
    assert len(good.rounds) == 2


def test_a_process_that_dies_is_a_problem_of_its_cases(workers: Workers) -> None:
    results = measure([fake_case(steps_left=90), fake_case("other")], workers, 0.05, 8)
    assert [r.problem for r in results] == ["failed: its process ended"] * 2
    with pytest.raises(WorkerError, match="ended"):
        workers.build(fake_case())


def test_medians_do_not_heed_one_bad_round() -> None:
    rounds = [{"steps": n, "ticks": n, "wall_s": 1.0, "cpu_s": 1.0} for n in (100, 1, 104, 96, 102)]
    result = Result(fake_case(), rounds=rounds)
    assert result.env_steps_per_s == 300
    assert result.cpu_seconds_per_step == pytest.approx(0.01)
    assert result.spread == (0.01, 1.04)


def test_workers_keep_to_one_thread_and_leave_this_process_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    with Workers([FAKE]) as workers:
        with pytest.raises(WorkerError, match="OMP_NUM_THREADS is 1"):
            workers.build(fake_case(tell="OMP_NUM_THREADS"))
        assert os.environ["OMP_NUM_THREADS"] == "2"


@pytest.mark.parametrize("exponent", [0.0, 1.0, 2.37])
def test_the_exponent_of_a_power_law_is_found(exponent: float) -> None:
    sizes = [1, 4, 16, 64]
    law = fit_power_law(sizes, [3e-4 * n**exponent for n in sizes])
    assert law.exponent == pytest.approx(exponent, abs=1e-9)
    assert law.factor == pytest.approx(3e-4)


def costs(sweep: Sweep, *seconds: float | None) -> list[Result]:
    return [
        Result(case, problem="failed")
        if cost is None
        else Result(case, rounds=[{"steps": 1, "ticks": 1, "wall_s": 5.0 * cost, "cpu_s": cost}])
        for case, cost in zip(sweep.cases(), seconds, strict=True)
    ]


def test_constant_costs_do_not_hide_the_growth_of_large_sizes() -> None:
    sweep = Sweep("worlds", True, (1, 10, 100, 1000, 10000))
    growth = summarise(sweep, costs(sweep, *(1e-3 + 1e-5 * n for n in sweep.sizes)))
    assert growth is not None
    assert growth.overall.exponent < 0.7
    assert growth.large.exponent == pytest.approx(0.86, abs=0.02)
    assert growth.row()["label"] == "worlds, sensed"


def test_sizes_that_failed_are_left_out() -> None:
    sweep = Sweep("vehicles", False, (2, 4, 8))
    growth = summarise(sweep, costs(sweep, 1.0, 2.0, None))
    assert growth is not None
    assert growth.sizes == [2, 4]
    assert growth.overall.exponent == pytest.approx(1.0)
    assert summarise(sweep, costs(sweep, 1.0, None, None)) is None


@pytest.mark.parametrize(("vehicles", "landmarks"), [(2, 3), (64, 3), (5, 64)])
def test_scenarios_of_any_size_are_possible(vehicles: int, landmarks: int) -> None:
    fixed = growth_scenario(vehicles, landmarks, sensed=False)
    assert (len(fixed.vehicles), len(fixed.landmarks)) == (vehicles, landmarks)
    assert {len(targets) for targets in neighbour_sets(fixed)} == {3}
    sensed = growth_scenario(vehicles, landmarks, sensed=True)
    assert [len(targets) for targets in neighbour_sets(sensed)] == [landmarks + i for i in range(vehicles)]


def test_vehicles_on_a_grid_keep_those_nearby() -> None:
    world = Engine(growth_scenario(64, 64, sensed=True, nearby=True)).world
    world.reset([0])
    world.advance(6)
    assert not world.view("collided").any()
    assert 0 < world.view("kept_count").min() < world.view("kept_count").max() <= MOST_NEARBY


def measured(case: Case, rate: float = 123456.0) -> Result:
    """A case that makes `rate` environment steps per second."""
    built = {"build_s": 0.1, "first_step_s": 0.1, "rss_bytes": 150e9 * case.worlds, "array_bytes": 150e9 * case.worlds}
    rounds = [{"steps": rate, "ticks": 30 * rate, "wall_s": case.worlds, "cpu_s": case.worlds}]
    return Result(case, built, rounds)


@pytest.fixture
def results() -> list[Result]:
    cases = own_cases("busy_intersection", coopenv.load_scenario("busy_intersection"))
    return [measured(c, 9.994e6) for c in cases] + [measured(c, 0.01) for c in peer_cases()]


def test_like_stands_against_like(results: list[Result]) -> None:
    found = ratios(results)
    assert {(r.ours, r.worlds) for r in found if r.peer.startswith("VMAS")} == {("make_vec", n) for n in (1, 32, 1024)}
    assert {(r.ours, r.threads) for r in found if r.peer.startswith(("highway", "mpe2"))} == {("ParallelEnv", 1)}
    first = found[0]
    assert first.env_steps == pytest.approx(9.994e8)
    assert first.agent_steps == pytest.approx(9.994e8 * 5 / 4)


# The command


@pytest.fixture(autouse=True)
def terminal(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.chdir(tmp_path)


def test_a_run_with_a_fake_peer(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    absent = peer_cases(quick=True)[0]
    monkeypatch.setattr(run, "PEERS", (FAKE, HIGHWAY))
    monkeypatch.setattr(run, "installed", lambda library: library is FAKE)
    monkeypatch.setattr(run, "peer_cases", lambda quick: [fake_case(), absent])
    monkeypatch.setattr(run, "own_cases", lambda *_: [fake_case("make_vec", worlds=32)])
    assert main(["--seconds", "0.01", "--repeats", "1", "--quick", "--out", "here"]) == 0
    out = capsys.readouterr().out
    assert max(len(line) for line in out.splitlines()) <= 80 and "…" not in out
    document = json.loads(Path("here/speed.json").read_text())
    assert document["command"].startswith("python -m benchmarks.speed ")
    assert all(row["env_steps_per_s"] > 0 for row in document["rows"])
    assert [row["name"] for row in document["rows"]] == ["make_vec", "fake"]
    assert document["without_figures"][0]["reason"] == "not installed: pip install highway-env"
    assert set(document["startup_s"]["imports"]) == {"coopenv", "fake"}
    assert "install highway-env" in out
    used = re.search(r"Cores used: (\d\.\d\d) by cases on 1", out)
    assert used is not None and float(used[1]) == SHARE < BUSY
    assert "figures are too low" in " ".join(out.split())
    assert "For fake: scans." in out
    assert "Files in here: speed.json, speed.png" in out


@pytest.mark.slow
def test_quick_from_end_to_end(capsys: pytest.CaptureFixture[str]) -> None:
    line = "--quick --growth --seconds 0.02 --repeats 1 --out here"
    assert main(line.split()) == 0
    out = capsys.readouterr().out
    document = json.loads(Path("here/speed.json").read_text())
    assert document["command"].startswith("python -m benchmarks.speed ")
    assert all(row["env_steps_per_s"] > 0 for row in document["rows"])
    assert max(len(line) for line in out.splitlines()) <= 80
    assert "…" not in out
    assert {path.name for path in Path("here").iterdir()} == {"speed.json", "speed.png", "growth.png"}
    shown = {row["name"] for row in document["rows"]} | {row["name"] for row in document["without_figures"]}
    assert {case.name for case in peer_cases()} <= shown
    assert {row["worlds"] for row in document["rows"] if row["name"] == "make_vec"} == {1, 32, 1024}
    assert all(row["array_bytes_per_world"] > 1000 for row in document["rows"] if row["library"] == "coopenv")
    assert len(document["growth"]) == 7
    assert all(growth["costs"] for growth in document["growth"])
    assert "coopenv" in document["startup_s"]["imports"]
