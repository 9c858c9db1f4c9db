"""The comparison of observers: same ticks for all, any number of processes, failures that stop nobody else."""

from __future__ import annotations

import json
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

import coopenv
from coopenv.bench.observer_table import error_table, failures, quality_table
from coopenv.bench.observers import compare
from coopenv.cli import main
from coopenv.estimation.observers import registry
from coopenv.estimation.observers.base import Estimate, Tick
from coopenv.estimation.observers.dead_reckoning import DeadReckoning
from coopenv.estimation.observers.runner import record, run

SHORT = {"horizon": 1.5}


def test_rows_are_root_means_over_seeds() -> None:
    scenario = coopenv.load_scenario("overtaking", SHORT)
    rows = compare(scenario, "overtaking", ["riccati", "dead_reckoning"], 2, 0.5)
    assert [(row.observer, row.vehicle) for row in rows] == [
        (name, f"vehicle_{i}") for name in ("riccati", "dead_reckoning") for i in (1, 2)
    ]
    errors = [run("riccati", record(scenario, seed)).position_error for seed in (0, 1)]
    late = np.arange(len(errors[0])) / 60 > 0.5
    expected = np.sqrt(np.mean([np.mean(e[late] ** 2, axis=0) for e in errors], axis=0))
    assert [row.position_rmse_m for row in rows[:2]] == pytest.approx(expected, rel=1e-12)
    assert all(row.bound_m < row.position_rmse_m for row in rows if row.observer == "riccati")


def test_processes_do_not_matter() -> None:
    scenario = coopenv.load_scenario("overtaking", SHORT)
    one, two = (compare(scenario, "overtaking", ["riccati"], 2, 0.5, jobs) for jobs in (1, 2))
    for a, b in zip(one, two, strict=True):
        assert (a.position_rmse_m, a.anees, a.settle_time_s) == (b.position_rmse_m, b.anees, b.settle_time_s)


class Raises(DeadReckoning):
    """Fails at its first update."""

    def update(self, tick: Tick) -> Estimate:
        """Fail."""
        raise ZeroDivisionError("by design")


def test_a_failing_observer_has_a_failed_row(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "_registered", {})
    registry.register("raises", Raises)
    scenario = coopenv.load_scenario("overtaking", SHORT)
    rows = compare(scenario, "overtaking", ["raises", "dead_reckoning"], 1, 0.5)
    assert "by design" in failures(rows)[0] and len(failures(rows)) == 1
    assert np.isfinite(rows[-1].position_rmse_m)
    printed = StringIO()
    Console(file=printed, width=80).print(error_table(rows), quality_table(rows))
    assert "failed" in printed.getvalue() and "…" not in printed.getvalue()


def test_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["bench", "observers", "overtaking", "--observers", "riccati,mekf", "--seeds", "1"]
    assert main([*arguments, "--set", "horizon=1.0", "--out", str(tmp_path / "board")]) == 0
    assert "riccati" in capsys.readouterr().out
    board = json.loads((tmp_path / "board" / "leaderboard.json").read_text())
    assert [row["observer"] for row in board["rows"]] == ["riccati"] * 2 + ["mekf"] * 2
    assert "--set horizon=1.0" in board["command"]
    assert len((tmp_path / "board" / "leaderboard.csv").read_text().splitlines()) == 5
    assert main(["bench", "observers", "overtaking", "--observers", "ricati"]) == 2
    assert "did you mean 'riccati'" in capsys.readouterr().err
    (tmp_path / "file").write_text("")
    assert main([*arguments, "--out", str(tmp_path / "file")]) == 2
    assert "file" in capsys.readouterr().err
