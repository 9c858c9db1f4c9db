"""Rows: figures by window worked out from the runs themselves, standard errors, protection levels beside errors."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import coopenv
from coopenv.base.errors import CoopenvError
from coopenv.bench.observers import compare, judge
from coopenv.bench.observers.judge import (
    LEVEL_BINS,
    START,
    TimeWindow,
    largest_after_start,
    level_measures,
    windows_of,
)
from coopenv.bench.observers.rows import (
    EDGES,
    UNKNOWN,
    WindowRow,
    checked_edges,
    mean_root,
    ratio,
    row_of,
    spread,
    verdict_of,
    verdict_on,
)
from coopenv.bench.observers.tables import level_figures
from coopenv.cli.app import main
from coopenv.estimation.metrics import Interval
from coopenv.observers import run
from coopenv.observers.bound import cramer_rao, cramer_rao_ancestors
from coopenv.observers.runner import Run
from coopenv.runs.recorder import record

SHORT = {"horizon": 3.0, "rates.camera": 20.0, "rates.odometry": 20.0}
EDGE = (0.5, 1.0, 2.0)


@pytest.fixture(scope="module")
def found() -> coopenv.Comparison:
    return compare(["mekf_covariance"], "lane:4", 3, overrides=SHORT, steady_from=2.5, windows=EDGE)


def test_rows_are_what_the_runs_say(found: coopenv.Comparison) -> None:
    scenario = coopenv.load_scenario("lane:4", SHORT)
    records = [record(scenario, seed) for seed in (0, 1, 2)]
    runs, bound = [run("mekf_covariance", made) for made in records], cramer_rao_ancestors(records[0])
    windows = [*pairwise(EDGE), (2.5, 3.0)]
    assert [(row.from_s, row.to_s) for row in found.window_rows[::4]] == windows
    assert [row.window for row in found.window_rows[::4]] == ["0.5-1 s", "1-2 s", "steady"]
    for n, (start, end) in enumerate(windows):
        within = (bound.t > start) & (bound.t < end + 1e-9)
        for i, row in enumerate(found.window_rows[4 * n : 4 * n + 4]):
            squares = np.array([np.mean(one.position_error[within, i] ** 2) for one in runs])
            nees = np.array([np.mean(one.nees[within, i]) / 6 for one in runs])
            rmse, limit = np.sqrt(squares.mean()), np.sqrt(np.mean(bound.position[within, i] ** 2))
            error = squares.std(ddof=1) / np.sqrt(3) / (2 * rmse)
            expected = (rmse, error, limit, rmse / limit, error / limit)
            got = (row.position_rmse_m, row.position_rmse_se_m, row.bound_ancestors_m, row.ratio_to_bound_ancestors)
            assert_allclose((*got, row.ratio_to_bound_ancestors_se), expected, rtol=1e-9)
            assert_allclose((row.anees, row.anees_se), (nees.mean(), nees.std(ddof=1) / np.sqrt(3)), rtol=1e-9)


def test_rows_have_the_bounds_of_the_runs(found: coopenv.Comparison) -> None:
    scenario = coopenv.load_scenario("lane:4", SHORT)
    records = [record(scenario, seed) for seed in (0, 1, 2)]
    late = records[0].t > 2.5
    errors = np.array([run("mekf_covariance", made).position_error[late] for made in records])
    squares = [np.mean(cramer_rao(made).position[late] ** 2, axis=0) for made in records]
    assert_allclose([row.bound_m for row in found.rows], np.sqrt(np.mean(squares, axis=0)), rtol=1e-12)
    median = np.median(np.sqrt(np.mean(errors**2, axis=1)), axis=0)
    assert_allclose([row.position_rmse_median_m for row in found.rows], median, rtol=1e-12)
    for row in found.rows:
        assert row.ratio_to_bound == pytest.approx(row.position_rmse_m / row.bound_m)
        assert max(row.bound_m, row.bound_neighbours_known_m) <= row.bound_ancestors_m * (1 + 1e-9)
        assert row.degradation == pytest.approx(1.0) and row.gramian_min_eigenvalue >= 0.0


def test_the_steady_window_is_the_leaderboard(found: coopenv.Comparison) -> None:
    for row, steady in zip(found.rows, found.windows_in("nominal", "mekf_covariance", found.windows[-1]), strict=True):
        assert row.position_rmse_m == steady.position_rmse_m and row.anees == steady.anees
        assert row.anees_se == steady.anees_se > 0.0
        assert row.ratio_to_bound_ancestors_se == steady.ratio_to_bound_ancestors_se


def test_the_worst_error_and_the_verdict_are_those_of_the_runs(found: coopenv.Comparison) -> None:
    scenario = coopenv.load_scenario("lane:4", SHORT)
    errors = np.array([run("mekf_covariance", record(scenario, seed)).position_error for seed in (0, 1, 2)])
    late = np.arange(errors.shape[1]) / 20.0 > START
    counted = np.where(late[:, None] | (errors > errors[:, :1]), errors, 0.0)
    assert_allclose([row.worst_after_start_m for row in found.rows], counted.max(axis=(0, 1)), rtol=1e-9)


def test_an_error_that_grows_at_the_start_counts_and_the_drawn_one_does_not() -> None:
    t = np.array([0.0, 0.1, 0.2, START, 1.1, 1.2])
    error = np.array([[5.0, 5.0, np.nan], [30.0, 4.0, np.nan], [3.0, 3.0, np.nan], *[[0.2, 0.3, np.nan]] * 3])
    np.testing.assert_array_equal(largest_after_start(t, error), [30.0, 0.3, np.nan])


def test_the_verdict_is_that_of_the_interval(found: coopenv.Comparison) -> None:
    for row in found.rows:
        word = "over" if row.anees > row.anees_high else "under"
        assert row.verdict == ("consistent" if row.anees_low <= row.anees <= row.anees_high else f"{word}confident")


def test_the_verdict_on_an_observer_is_the_worst_of_its_vehicles(found: coopenv.Comparison) -> None:
    words = ["consistent", "overconfident", "overconfident", "underconfident"]
    rows = [replace(row, verdict=word) for row, word in zip(found.rows, words, strict=True)]
    assert verdict_on(rows) == "overconfident 2/4" and verdict_on(rows[:1]) == "consistent"
    assert verdict_on(rows[3:]) == "underconfident"
    assert verdict_of(np.nan, Interval(0.8, 1.2)) == "no covariance"


def test_fewer_degrees_of_freedom_than_seeds_have_no_bounds(found: coopenv.Comparison) -> None:
    """The consistency of a few innovations in many seeds."""
    runs = found.groups["nominal", "mekf_covariance"]
    few = [replace(one, measures={**one.measures, "nis_dof": np.array([n, 0, 0, 0])}) for n, one in enumerate(runs)]
    row = row_of("lane:4", few[:2] * 2, few[:2] * 2, 0)
    assert np.isnan([row.nis_low, row.nis_high]).all() and np.isfinite(row.position_rmse_m)


def test_windows_end_with_the_run() -> None:
    assert windows_of(EDGES, 20.0, 15.0) == (
        TimeWindow(5.0, 10.0),
        TimeWindow(10.0, 15.0),
        TimeWindow(20.0, 15.0, steady=True),
    )
    assert windows_of((), 0.0, 5.0) == (TimeWindow(0.0, 5.0, steady=True),)
    assert not TimeWindow(1.0, 2.0).ticks(np.array([1.0])).any() and TimeWindow(1.0, 2.0).ticks(np.array([2.0])).all()


@pytest.mark.parametrize("given", ["5", "5,4", "a,b", "-1,3", "1,inf", "1,1", ",".join(map(str, range(30)))])
def test_invalid_edges_are_reported(given: str) -> None:
    with pytest.raises(CoopenvError, match=r"--windows .*expected 2 to 20 increasing times in s, such as 5,10,20,35"):
        checked_edges(given)


def test_edges() -> None:
    assert checked_edges("5, 10,20") == checked_edges([5, 10, 20]) == (5.0, 10.0, 20.0)
    assert checked_edges("none") == checked_edges("") == checked_edges([]) == ()


def test_the_worst_anees_is_the_farthest_from_one() -> None:
    def row(vehicle: str, anees: float, rmse: float) -> WindowRow:
        return WindowRow("e", "v", "o", vehicle, "w", 0, 1, rmse, 0.1, 1.0, rmse, 0.1, anees, 0.2)

    rows = [row("vehicle_1", 0.1, 3.0), row("vehicle_2", 5.0, 1.0), row("vehicle_3", 1.2, 2.0)]
    assert spread(rows, "anees") == (1.2, 0.1, 0.2, "vehicle_1")
    assert spread(rows, "position_rmse_m") == (2.0, 3.0, 0.1, "vehicle_1")
    assert np.isnan(spread([row("vehicle_1", np.nan, np.nan)], "anees").worst)


def test_seeds_share_one_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    """It depends on what was true and seen, not on the noise: of many vehicles it takes minutes."""
    counted = Mock(side_effect=cramer_rao_ancestors)
    monkeypatch.setattr(judge, "cramer_rao_ancestors", counted)
    monkeypatch.setattr(judge, "_kept", type(judge._kept)())
    compare(["dead_reckoning"], "lane:2", 3, overrides={"horizon": 0.5})
    assert counted.call_count == 1
    compare(["dead_reckoning"], "lane:2", 2, overrides={"horizon": 0.5, "noise.bearing.scale": 0.01})
    assert counted.call_count == 2


def test_the_command_writes_and_prints_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["bench", "observers", "lane:12", "--observers", "mekf_covariance", "--seeds", "2"]
    words += ["--windows", "0.2,0.5,2"]
    assert main([*words, "--set", "horizon=1.0", "--jobs", "1", "--out", str(tmp_path / "new")]) == 0
    printed = capsys.readouterr().out
    assert max(len(line) for line in printed.splitlines() if not line.startswith("Files in")) <= 100
    matching = [line for line in printed.splitlines() if line.startswith("mekf_covariance 0.2-0.5 s")]
    assert len(matching) == 1 and matching[0].split()[-1].startswith("f")
    board = json.loads((tmp_path / "new" / "leaderboard.json").read_text())
    assert "--windows 0.2,0.5,2" in board["command"]
    with (tmp_path / "new" / "windows.csv").open() as file:
        table = list(csv.DictReader(file))
    assert [float(row["anees"]) for row in table] == [row["anees"] for row in board["windows"]]
    assert [row["window"] for row in table[::12]] == ["0.2-0.5 s", "0.5-1 s", "steady"]
    page = (tmp_path / "new" / "report.html").read_text()
    assert "By window" in page and page.count("0.5-1 s") == 1


def test_few_vehicles_are_shown_one_by_one(found: coopenv.Comparison) -> None:
    lines = str(found).splitlines()
    rows = found.windows_in("nominal", "mekf_covariance", found.windows[0])
    shown = [line.split() for line in lines if line.startswith("mekf_covariance 0.5-1 s")]
    assert len(shown) == 2  # ratios and ANEES
    assert float(shown[0][3].partition("(")[0]) == pytest.approx(rows[0].ratio_to_bound_ancestors, abs=0.06)
    assert float(shown[1][3].partition("(")[0]) == pytest.approx(rows[0].anees, abs=0.06)


EXPERIMENTS, SEEDS, VEHICLES = 2000, 40, 3


def squares(generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return (E, S, N) mean squares of an observer and of a worse one, which shares most of its errors."""
    common = generator.gamma(6.0, 1.0, (EXPERIMENTS, SEEDS, 1)) * np.array([1.0, 2.0, 5.0])
    own, other = (common * generator.gamma(30.0, 1 / 30.0, (EXPERIMENTS, SEEDS, VEHICLES)) for _ in range(2))
    return own, 4.0 * other


def test_standard_errors_are_the_spread_of_repetitions() -> None:
    one, two = squares(np.random.default_rng(0))
    roots = [mean_root(s) for s in one]
    assert np.mean([r.error for r in roots]) == pytest.approx(np.std([r.value for r in roots]), rel=0.06)
    ratios = [ratio(b, a) for a, b in zip(one, two, strict=True)]
    assert np.mean([r.value for r in ratios]) == pytest.approx(2.0, rel=0.01)
    assert np.mean([r.error for r in ratios]) == pytest.approx(np.std([r.value for r in ratios]), rel=0.06)
    unpaired = np.hypot(roots[0].error / roots[0].value, mean_root(two[0]).error / mean_root(two[0]).value) * 2.0
    assert ratios[0].error < 0.6 * unpaired  # what both share cancels


def test_values() -> None:
    found = mean_root(np.array([[1.0, 4.0], [9.0, 16.0]]))
    assert found.value == pytest.approx((np.sqrt(5.0) + np.sqrt(10.0)) / 2)
    assert mean_root(np.array([[9.0]])).value == 3.0 and np.isnan(mean_root(np.array([[9.0]])).error)
    same = np.array([[1.0], [2.0]])
    assert ratio(same, same) == (1.0, 0.0)
    assert mean_root(np.zeros((3, 2))) == (0.0, 0.0)
    assert ratio(same, 0.0 * same) is UNKNOWN and ratio(same, np.nan * same) is UNKNOWN


DRIVE = {**SHORT, "horizon": 4.0}
NAMES = ("level_exceeded", "angle_level_exceeded", "level_unknown", "level_over_e95")
INF, NAN = np.inf, np.nan


@pytest.fixture(scope="module")
def drive() -> Run:
    return run("dead_reckoning", record(coopenv.load_scenario("lane:2", {**DRIVE, "horizon": 0.4}), 0))


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
    return compare(["robust", "dead_reckoning"], "busy_intersection_tracking", 2, overrides=DRIVE, steady_from=2.0)


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
    assert (panel.get_xlabel(), panel.get_ylabel()) == ("horizontal error [m], log", "protection level [m], log")
    assert panel.get_xlim() == panel.get_ylim() and bar.get_ylabel() == "vehicle ticks"
    (mesh,) = (drawn for drawn in panel.collections if drawn.get_array() is not None)
    shown: Any = np.ma.filled(np.ma.masked_invalid(mesh.get_array()), 0.0).reshape((len(LEVEL_BINS) - 1,) * 2)
    made = [run("robust", record(coopenv.load_scenario("busy_intersection_tracking", DRIVE), seed)) for seed in (0, 1)]
    known = [one.protection_level[..., 0][np.isfinite(one.protection_level[..., 0])] for one in made]
    assert shown.sum() == sum(len(levels) for levels in known)
    assert_array_equal(shown.sum(axis=1), np.histogram(np.concatenate(known), LEVEL_BINS)[0])  # levels are upward
    assert np.tril(shown, -1).sum() > 0 and np.triu(shown, 1).sum() == 0


def test_nothing_to_draw(board: coopenv.Comparison) -> None:
    silent = replace(board, observers=("dead_reckoning",), samples=board.groups["nominal", "dead_reckoning"])
    with pytest.raises(coopenv.CoopenvError, match="figure 'protection': there is nothing to draw"):
        silent.figure("protection")
    assert "protection level" not in str(silent)
