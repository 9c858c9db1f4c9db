"""Protection levels beside errors: shares of a run made by hand, the diagram's counts, and a recorded drive."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import coopenv
from coopenv.bench.observers import compare
from coopenv.bench.observers.judge import LEVEL_BINS, level_measures
from coopenv.bench.observers.tables import level_figures
from coopenv.observers import run
from coopenv.observers.runner import Run
from coopenv.runs.recorder import record

SHORT = {"horizon": 4.0, "rates.camera": 20.0, "rates.odometry": 20.0}
NAMES = ("level_exceeded", "angle_level_exceeded", "level_unknown", "level_over_e95")
INF, NAN = np.inf, np.nan


@pytest.fixture(scope="module")
def drive() -> Run:
    return run("dead_reckoning", record(coopenv.load_scenario("lane:2", {**SHORT, "horizon": 0.4}), 0))


def test_shares_of_a_run_made_by_hand(drive: Run) -> None:
    """Of vehicle 1, tick 0 states nothing, and at tick 8 the truth is unknown; vehicle 2 states nothing at all."""
    K, N = drive.judged.shape
    assert (K, N) == (9, 2)
    level, error, judged = np.full((K, N, 2), NAN), np.ones((K, N)), np.ones((K, N), bool)
    level[1:, 0] = [(2, 0.1), (0.5, 0.1), (1, 0.001), (INF, INF), (INF, INF), (4, 1), (6, 0.1), (0.1, 1e-6)]
    error[8, 0], judged[8, 0] = NAN, False
    made = replace(drive, protection_level=level, judged=judged, orientation_error=np.full((K, N), np.degrees(0.05)))
    found = level_measures(error, made)
    assert_allclose([found[name][0] for name in NAMES], [1 / 7, 1 / 7, 2 / 7, 2.0])
    assert np.isnan([found[name][1] for name in NAMES]).all()


def test_an_observer_that_knows_no_level(drive: Run) -> None:
    unknown = level_measures(drive.position_error, replace(drive, protection_level=np.full((9, 2, 2), INF)))
    assert_array_equal([unknown[name] for name in NAMES], [[0, 0], [0, 0], [1, 1], [NAN, NAN]])


@pytest.fixture(scope="module")
def board() -> coopenv.Comparison:
    return compare(["robust", "dead_reckoning"], "busy_intersection_tracking", 2, overrides=SHORT, steady_from=2.0)


def test_a_nominal_drive_exceeds_no_level(board: coopenv.Comparison) -> None:
    """At risk 1e-3; the bounds hold with a faulty source, so that without one they are hardly ever reached."""
    rows = board.rows_in("nominal", "robust")
    for row in rows:
        assert row.level_exceeded_fraction < 0.002 and row.angle_level_exceeded_fraction < 0.002
        assert 0.0 <= row.level_unknown_fraction < 0.2 and 1.0 < row.level_over_e95 < 300.0
    assert all(np.isnan(row.level_exceeded_fraction) for row in board.rows_in("nominal", "dead_reckoning"))
    (name, figures), *others = level_figures(board, "nominal").items()
    assert name == "robust" and not others
    assert figures[2].value == pytest.approx(100 * np.mean([row.level_unknown_fraction for row in rows]))
    assert "protection level" in str(board)


def test_stanford_diagram(board: coopenv.Comparison) -> None:
    """A panel for the observer that states levels; its cells hold every tick with a known level once."""
    panel, bar = board.figure("protection").axes
    assert panel.get_title().startswith("robust\nexceeded 0 %, unknown ")
    assert (panel.get_xlabel(), panel.get_ylabel()) == ("horizontal error [m]", "protection level [m]")
    assert panel.get_xlim() == panel.get_ylim() and bar.get_ylabel() == "vehicle ticks"
    (mesh,) = (drawn for drawn in panel.collections if drawn.get_array() is not None)
    shown: Any = np.ma.filled(np.ma.masked_invalid(mesh.get_array()), 0.0).reshape((len(LEVEL_BINS) - 1,) * 2)
    made = [run("robust", record(coopenv.load_scenario("busy_intersection_tracking", SHORT), seed)) for seed in (0, 1)]
    known = [one.protection_level[..., 0][np.isfinite(one.protection_level[..., 0])] for one in made]
    assert shown.sum() == sum(len(levels) for levels in known)
    assert_array_equal(shown.sum(axis=1), np.histogram(np.concatenate(known), LEVEL_BINS)[0])  # levels are upward
    assert np.tril(shown, -1).sum() > 0 and np.triu(shown, 1).sum() == 0


def test_nothing_to_draw(board: coopenv.Comparison) -> None:
    silent = replace(board, observers=("dead_reckoning",), samples=board.groups["nominal", "dead_reckoning"])
    with pytest.raises(coopenv.CoopenvError, match="figure 'protection': there is nothing to draw"):
        silent.figure("protection")
    assert "protection level" not in str(silent)
