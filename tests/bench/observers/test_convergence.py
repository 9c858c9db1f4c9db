"""Convergence: the same draws come again and are counted; a study over seeds is the same as single runs."""

from __future__ import annotations

import json
from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation
from scipy.stats import kstest

import coopenv
from coopenv.bench.executors import Local
from coopenv.bench.observers import find_source
from coopenv.bench.observers.convergence import (
    Draw,
    basin_failures,
    basin_table,
    basins_of,
    by_angle,
    draw_starts,
    random_start,
    study_basin,
    study_seeds,
)
from coopenv.cli.app import main
from coopenv.observers import Estimate, Recording, Tick, find, run
from coopenv.observers.pose_filters import DeadReckoning
from coopenv.runs import rollout
from coopenv.runs.recorder import record
from tests.helpers.commands import printed, refused


@cache
def made() -> Recording:
    return record(coopenv.load_scenario("busy_intersection", {"horizon": 0.1}), 0)


def test_an_observer_starts_at_the_given_estimate() -> None:
    started = random_start(made(), 7)
    result = run("mekf", started)
    assert_array_equal(result.rotation[0], started.start_rotation)
    assert_array_equal(result.position[0], started.start_position)
    assert started.bearings is made().bearings and not started.start_rotation.flags.writeable
    assert_array_equal(started.start_rotation, random_start(made(), 7).start_rotation)
    assert (started.start_position != random_start(made(), 8).start_position).all()


def test_starts_are_uniform() -> None:
    starts = [random_start(made(), seed) for seed in range(400)]
    R = np.concatenate([s.start_rotation for s in starts])
    offset = np.concatenate([s.start_position - made().truth.position[0] for s in starts])
    angle = Rotation.from_matrix(R).magnitude()
    assert kstest(angle, lambda a: (a - np.sin(a)) / np.pi).pvalue > 0.01  # Haar measure
    assert kstest(np.linalg.norm(offset, axis=1), lambda r: (np.clip(r, 0, 15) / 15) ** 3).pvalue > 0.01
    P = starts[0].start_covariance[0]
    rotvec = Rotation.from_matrix(R).as_rotvec()
    assert_allclose(np.diag(P), [*np.mean(rotvec**2, axis=0), *np.mean(offset**2, axis=0)], rtol=0.1)


def draws_of(number: int, angles: list[float], ends: list[float], time: float) -> list[Draw]:
    return [
        Draw(number, "made_up", f"vehicle_{i}", angle, 3.0, end < 0.1, time, end, 0.5, "")
        for i, (angle, end) in enumerate(zip(angles, ends, strict=True))
    ]


def test_a_draw_converges_when_every_vehicle_does() -> None:
    draws = [*draws_of(0, [10, 100], [0.01, 0.02], 4.0), *draws_of(1, [20, 179], [0.01, 0.2], np.nan)]
    (basin,) = basins_of("here", draws)
    assert (basin.converged_fraction, basin.by_vehicle, basin.convergence_time_s) == (0.5, (1.0, 0.5), 4.0)
    assert basin.interval.low < 0.5 < basin.interval.high and basin.draws == 2
    assert by_angle(draws) == [(2, 2), (0, 0), (0, 0), (1, 1), (0, 0), (0, 1)]


def test_a_failed_run_does_not_converge() -> None:
    (basin,) = basins_of("here", draws_of(0, [10, 10], [np.nan, np.nan], np.nan))
    assert basin.converged_fraction == 0.0 and np.isnan(basin.convergence_time_s)


class RaisesUpsideDown(DeadReckoning):
    """Fails from wide starts only."""

    def update(self, tick: Tick) -> Estimate:
        estimate = super().update(tick)
        return 1 / 0 if estimate.rotation[2, 2] < 0 else estimate  # type: ignore[return-value]


def test_failures_are_counted_and_reported() -> None:
    factories = {"raises": RaisesUpsideDown, "mekf": find("mekf")}
    source = find_source("overtaking", {"horizon": 0.1})
    draws = [draw for seed in range(6) for draw in draw_starts(source, factories, seed)]
    raises, mekf = basins_of("here", draws)
    failures = [draw.failure for draw in draws if draw.failure]
    assert 0 < 2 * raises.failed == len(failures) < 12 and raises.failure == failures[0]
    assert (mekf.failed, mekf.failure) == (0, "")
    (line,) = basin_failures([raises, mekf])
    assert line.startswith(f"raises (basin): failed in {raises.failed} of 6 draws, first at vehicle_")
    assert "ZeroDivisionError" in line
    assert {draw.failure for draw in draws if draw.observer == "mekf"} == {""}
    assert printed(basin_table([raises, mekf])).splitlines()[3].split()[:3] == ["raises", "6", str(raises.failed)]


def test_draws_are_reproducible() -> None:
    source = find_source("overtaking", {"horizon": 1.0})
    one, two = (study_basin(source, ["riccati"], 3, Local(1)) for _ in range(2))
    assert [d.draw for d in one] == [0, 0, 1, 1, 2, 2]
    assert str(one) == str(two) and all(d.initial_position_error_m <= 15.0 for d in one)


def test_study_equals_single_runs() -> None:
    scenario = coopenv.load_scenario("overtaking", {"horizon": 4.0})
    study = study_seeds(scenario, range(5, 8), 2.0)
    for row, seed in enumerate(study.seeds):
        alone = rollout(scenario, seed=seed)
        steady = alone.t > 2.0
        expected = np.sqrt((alone.position_error[steady] ** 2).mean(axis=0))
        np.testing.assert_allclose(study.position_rmse_m[row], expected, rtol=1e-12)
        np.testing.assert_array_equal(study.final_position_error_m[row], alone.position_error[-1])


def test_all_vehicles_settle_under_the_papers_noise() -> None:
    """Seeds 0..19 of the busy intersection: every vehicle in every seed, with errors that grow along the chain."""
    study = study_seeds(coopenv.load_scenario("busy_intersection"), range(20), 35.0)
    assert np.isfinite(study.settle_time_s).all()
    assert (study.final_position_error_m < 0.5).all() and (study.final_orientation_error_deg < 5.0).all()
    mean = study.position_rmse_m.mean(axis=0)
    assert (np.diff(mean) > 0).all()
    assert mean == pytest.approx([0.0124, 0.0202, 0.0370, 0.0541, 0.106], rel=0.35)


def test_command(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["bench", "seeds", "overtaking", "--seeds", "2", "--set", "horizon=2.0"]
    assert main(words) == 0
    printed = capsys.readouterr().out
    assert "vehicle_2" in printed and "2/2" in printed
    assert main([*words, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["seeds"] == [0, 1]
    assert [vehicle["vehicle"] for vehicle in found["vehicles"]] == ["vehicle_1", "vehicle_2"]
    assert all(len(vehicle["position_rmse_m"]) == 2 for vehicle in found["vehicles"])
    error_text = refused("bench", "seeds", "overtaking", "--steady-from", "99")
    assert "steady_from 99 is not within the run of 45 s" in error_text
