"""Measuring through a real worker process."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator

import pytest

from benchmarks.speed.measure import Result, measure, units_of_work
from benchmarks.speed.workers import WorkerError, Workers
from tests.helpers.fake_library import FAKE, SHARE, STEP, fake_case


@pytest.fixture
def workers() -> Iterator[Workers]:
    with Workers([FAKE]) as workers:
        yield workers


def test_rates_are_of_the_work_done(workers: Workers) -> None:
    told: list[str] = []
    cases = [fake_case(), fake_case("other", worlds=1)]
    results = measure(cases, workers, seconds=0.05, repeats=3, on_progress=told.append)
    assert len(told) == units_of_work(cases, 3)
    assert told[0] == "building fake x 3"
    for result, worlds in zip(results, (3, 1), strict=True):
        assert len(result.rounds) == 3
        assert result.env_steps_per_s == pytest.approx(worlds / STEP)
        assert result.agent_steps_per_s == pytest.approx(2 * result.env_steps_per_s)
        assert result.vehicle_ticks_per_s == pytest.approx(5 * result.env_steps_per_s)
        assert result.cores_used == pytest.approx(SHARE)


def test_a_row_is_plain_data_with_the_keys_that_readers_rely_on(workers: Workers) -> None:
    row = json.loads(json.dumps(measure([fake_case(bytes=60 << 20)], workers, 0.01, 1)[0].row()))
    expected = {"name": "fake", "worlds": 3, "vehicles": 2, "threads": 1, "dtype": "float64"}
    assert {key: row[key] for key in expected} == expected
    for key in ("env_steps_per_s", "agent_steps_per_s", "vehicle_ticks_per_s"):
        assert row[key] > 0
    assert row["counted_as_vehicle_ticks"] == "scans"
    assert [row["slowest_round"], row["fastest_round"]] == pytest.approx([1.0, 1.0])
    assert row["array_bytes_per_world"] == 20 << 20
    if sys.platform == "linux":
        assert row["rss_bytes_per_world"] == pytest.approx(20 << 20, rel=0.2)


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
    assert result.seconds_per_step == pytest.approx(0.01)
    assert result.spread == (0.01, 1.04)


def test_workers_keep_to_one_thread_and_leave_this_process_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    with Workers([FAKE]) as workers:
        with pytest.raises(WorkerError, match="OMP_NUM_THREADS is 1"):
            workers.build(fake_case(tell="OMP_NUM_THREADS"))
        assert os.environ["OMP_NUM_THREADS"] == "2"
