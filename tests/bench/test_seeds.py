"""The study over seeds is the same as single runs, and states the paper's simulation with its spread."""

from __future__ import annotations

import json

import numpy as np
import pytest

import coopenv
from coopenv.bench.seeds import study_seeds
from coopenv.cli import main
from coopenv.runs import rollout


def test_study_equals_single_runs() -> None:
    scenario = coopenv.load_scenario("overtaking", {"horizon": 4.0})
    study = study_seeds(scenario, range(5, 8), 2.0)
    for row, seed in enumerate(study.seeds):
        run = rollout(scenario, seed=seed)
        steady = run.t > 2.0
        expected = np.sqrt((run.position_error[steady] ** 2).mean(axis=0))
        np.testing.assert_allclose(study.position_rmse_m[row], expected, rtol=1e-12)
        np.testing.assert_array_equal(study.final_position_error_m[row], run.position_error[-1])


def test_all_vehicles_settle_under_the_papers_noise() -> None:
    """Seeds 0..19 of the busy intersection: every vehicle in every seed, with errors that grow along the chain."""
    study = study_seeds(coopenv.load_scenario("busy_intersection"), range(20), 35.0)
    assert np.isfinite(study.settle_time_s).all()
    assert (study.final_position_error_m < 0.5).all() and (study.final_orientation_error_deg < 5.0).all()
    mean = study.position_rmse_m.mean(axis=0)
    assert (np.diff(mean) > 0).all()
    assert mean == pytest.approx([0.0124, 0.0202, 0.0370, 0.0541, 0.106], rel=0.35)


def test_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "seeds", "overtaking", "--seeds", "2", "--set", "horizon=2.0"]) == 0
    printed = capsys.readouterr().out
    assert "vehicle_2" in printed and "2/2" in printed
    assert main(["bench", "seeds", "overtaking", "--steady-from", "99"]) == 2
    assert "steady_from 99 is not within the run of 45 s" in capsys.readouterr().err


def test_json_has_one_figure_per_seed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "seeds", "overtaking", "--seeds", "3", "--set", "horizon=1.0", "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["seeds"] == [0, 1, 2]
    assert [vehicle["vehicle"] for vehicle in printed["vehicles"]] == ["vehicle_1", "vehicle_2"]
    assert all(len(vehicle["position_rmse_m"]) == 3 for vehicle in printed["vehicles"])
