"""Arguments and results of `coopenv.compare`: figures by hand, tables, pictures, files."""

from __future__ import annotations

import csv
import re
import shutil
import subprocess
from dataclasses import fields, replace
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.text import Text
from scipy.stats import chi2

import coopenv
from coopenv.base.errors import CoopenvError
from coopenv.base.format import in_parentheses, number, with_error
from coopenv.bench.observers import compare, find_source
from coopenv.bench.observers.command import report_text
from coopenv.bench.observers.comparison import Plan
from coopenv.bench.observers.faults import VARIANTS
from coopenv.bench.observers.figures import _document, page_file
from coopenv.bench.observers.judge import sample_of, scene_of
from coopenv.bench.observers.rows import Leaderboard, Row, verdict_on
from coopenv.bench.observers.sources import variants_of
from coopenv.bench.observers.tables import everything, failures, largest_error
from coopenv.cli.bench import ObserverOptions
from coopenv.observers import registry, run
from coopenv.observers.pose_filters import DeadReckoning
from coopenv.runs.recorder import record
from coopenv.viz.figures import COLUMNS
from tests.helpers import mrclam_files
from tests.helpers.commands import printed
from tests.helpers.odd_observers import Raises, Tells

SHORT = {"horizon": 1.5}


def test_every_fault_has_its_rows() -> None:
    short = {"horizon": 2.0}
    found = compare(["mekf_covariance"], "busy_intersection", 1, variants="all", overrides=short, steady_from=1.0)
    rows = found.rows
    assert list(dict.fromkeys(row.variant for row in rows)) == list(VARIANTS)
    rmse = {name: [row.position_rmse_m for row in rows if row.variant == name] for name in VARIANTS}
    for name in set(VARIANTS) - {"nominal"}:
        assert rmse[name] != pytest.approx(rmse["nominal"], rel=1e-3)
        ratios = [row.degradation for row in rows if row.variant == name]
        assert ratios == pytest.approx(np.divide(rmse[name], rmse["nominal"]))
        total = found.totals[name, "mekf_covariance"]
        assert total.degradation.value == pytest.approx(sum(rmse[name]) / sum(rmse["nominal"]))
    assert rmse["lying_neighbour"][:2] == pytest.approx(rmse["nominal"][:2], rel=1e-9)  # the liar and its leader


def test_vehicles_without_any_truth_are_not_judged() -> None:
    source = find_source("busy_intersection", {"horizon": 3.0})
    whole = record(source.world(), 3)
    for array in (whole.truth.position, whole.truth.rotation):
        array[:, 1] = np.nan
    scene, run_of = scene_of(whole, 1.0), run("mekf_covariance", whole)
    judged = sample_of("nominal", "mekf_covariance", scene, whole, run_of)
    board = Leaderboard("mine", ("mekf_covariance",), {"nominal": ""}, (3,), [judged])
    assert board.vehicles == ("vehicle_1", "vehicle_3", "vehicle_4", "vehicle_5")
    expected = run_of.position_rmse(1.001)[[0, 2, 3, 4]]
    assert [row.position_rmse_m for row in board.rows] == pytest.approx(expected)
    assert board.totals["nominal", "mekf_covariance"].rmse.value == pytest.approx(expected.mean())
    text = printed(*everything(board))
    assert re.search(r"f1 +f3 +f4 +f5 +mean", text) and "Not judged, as no true poses are known: vehicle_2." in text


SOURCE = """
from coopenv.observers.pose_filters import DeadReckoning

class Mine(DeadReckoning):
    pass
"""


def test_observers_travel_to_other_processes(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """One fails, and the others go on; another tells its NIS; the last one is loaded from its file there."""
    monkeypatch.setattr(registry, "_registered", {})
    registry.register("raises", Raises)
    registry.register("tells", Tells)
    (tmp_path / "mine.py").write_text(SOURCE)
    names = ["raises", "tells", "dead_reckoning", f"{tmp_path}/mine.py:Mine"]
    rows = compare(names, "overtaking", 2, overrides=SHORT, steady_from=0.5, jobs=2).rows
    assert len(failures(rows)) == 1 and "by design" in failures(rows)[0]
    assert np.isnan(rows[0].position_rmse_m) and rows[0].settled_fraction == 0.0 and rows[0].diverged_fraction == 1.0
    assert [row.nis for row in rows[2:4]] == pytest.approx([1.5, 1.5]) and np.isnan(rows[-1].nis)
    errors = [row.position_rmse_m for row in rows]
    assert errors[2:4] == pytest.approx(errors[4:6]) and errors[4:6] == errors[6:]
    dof = 2 * 2 * 60  # of two seeds, 1 s at 60 Hz
    assert [rows[2].nis_low, rows[2].nis_high] == pytest.approx(chi2.ppf([0.025, 0.975], dof) / dof)
    assert [rows[2].anees_low, rows[2].anees_high] == pytest.approx(chi2.ppf([0.025, 0.975], 12) / 12)
    assert np.isnan([rows[0].anees_low, rows[-1].nis_low]).all()


class Mine(DeadReckoning):
    """An observer of one's own."""


@pytest.fixture(scope="module")
def comparison() -> coopenv.Comparison:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(registry, "_registered", {})
        short: dict[str, Any] = {"overrides": {"horizon": 1.0}, "steady_from": 0.5}
        return coopenv.compare(
            [Raises, Mine, "riccati"], "overtaking", [3, 8], variants=["nominal", "v2x_loss"], **short
        )


def test_what_was_compared(comparison: coopenv.Comparison) -> None:
    assert comparison.observers == ("Raises", "Mine", "riccati")
    assert comparison.seeds == (3, 8) and list(comparison.variants) == ["nominal", "v2x_loss"]
    assert comparison.title == "overtaking, seeds 3, 8"
    assert replace(comparison, seeds=(4, 5, 6)).title == "overtaking, seeds 4 to 6"
    assert replace(comparison, seeds=(4,)).title == "overtaking, seed 4"
    assert comparison.ranked == ["riccati", "Mine", "Raises"]
    assert len(comparison.rows) == 2 * 3 * 2 and all(isinstance(row, Row) for row in comparison.rows)


def test_tables(comparison: coopenv.Comparison) -> None:
    text = str(comparison)
    lines = [line.split()[0] for line in text.splitlines() if line.startswith(("riccati", "Mine", "Raises"))]
    assert lines[:3] == ["riccati", "Mine", "Raises"]
    assert "ratio" not in text and "bound (ancestors)" in text and "0.0123(4): 0.0123 with a standard error" in text
    row = comparison.rows_in("v2x_loss", "riccati")[0]
    assert in_parentheses(row.position_rmse_m, row.position_rmse_se_m) in printed(comparison.table("v2x_loss"))


def test_csv_and_latex(comparison: coopenv.Comparison, tmp_path: Path) -> None:
    table = list(csv.DictReader(StringIO(comparison.to_csv(tmp_path / "rows.csv"))))
    assert (tmp_path / "rows.csv").read_text() == comparison.to_csv()
    assert [line["observer"] for line in table[:6]] == ["Raises"] * 2 + ["Mine"] * 2 + ["riccati"] * 2
    assert table[0]["position_rmse_m"] == "" and float(table[4]["position_rmse_se_m"]) > 0
    text = comparison.to_latex(tmp_path / "rows.tex")
    assert (tmp_path / "rows.tex").read_text() == text
    row = comparison.rows_in("nominal", "riccati")[0]
    assert in_parentheses(row.position_rmse_m, row.position_rmse_se_m) in text
    assert r" & f1 & f2 \\" in text and text.count(r"\\") == 1 + 3 + 3 + 1 + 3
    body = [line for line in text.splitlines() if "&" in line]
    assert [line.count("&") for line in body] == [2] * 7 + [1] * 4
    riccati = comparison.rows_in("nominal", "riccati")
    assert f"riccati & \\multicolumn{{2}}{{l}}{{{number(largest_error(riccati), 2)} m, {verdict_on(riccati)}}}" in text
    assert r"Raises & failed & failed \\" in text


def test_the_table_fits_a_column_of_a_paper(tmp_path: Path) -> None:
    """Five vehicles and an observer with a long name in 3.5 in, as LaTeX sets them."""
    style = shutil.which("kpsewhich") and subprocess.run(["kpsewhich", "booktabs.sty"], capture_output=True).stdout
    if not (style and shutil.which("pdflatex")):
        pytest.skip("LaTeX with booktabs is not installed")
    names, short = ["split_covariance_intersection", "dead_reckoning"], {"horizon": 1.0}
    found = coopenv.compare(names, "busy_intersection_tracking", 2, overrides=short, steady_from=0.5)
    found.to_latex(tmp_path / "rows.tex")
    paper = r"\documentclass{article}\usepackage{booktabs}\begin{document}\noindent"
    paper += r"\begin{minipage}{3.5in}\input{rows}\end{minipage}\end{document}"
    (tmp_path / "paper.tex").write_text(paper)
    command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "paper"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, errors="replace", timeout=120)
    assert done.returncode == 0 and "Overfull" not in done.stdout, done.stdout[-2000:]


def test_tables_have_the_units_that_the_columns_state(comparison: coopenv.Comparison) -> None:
    frame, units = comparison.to_pandas(), comparison.columns().units
    assert len(frame) == 12 and frame.attrs["units"] == units
    for column in fields(Row):
        meaning = column.metadata["meaning"].partition(";")[0]
        if unit := re.search(r", (m|deg|s|1/s|bytes per second|microseconds)$", meaning):
            assert units[column.name] == {"bytes per second": "byte/s", "microseconds": "us"}.get(unit[1], unit[1])
    data = comparison.to_xarray(windows=True)
    assert list(data.observer.values) == list(comparison) and data.sizes["vehicle"] == 2
    for row in comparison.window_rows:
        cell = data.sel(variant=row.variant, observer=row.observer, window=row.window, vehicle=row.vehicle)
        np.testing.assert_equal(float(cell.position_rmse_m), row.position_rmse_m)
    assert comparison.to_polars().columns == list(frame.columns)


def test_one_observer_of_a_comparison(comparison: coopenv.Comparison) -> None:
    assert len(comparison) == 3 and "riccati" in comparison and "robust" not in comparison
    alone = comparison["riccati"]
    assert str(alone.rows) == str([row for row in comparison.rows if row.observer == "riccati"])
    assert "riccati" in str(alone) and "Mine" not in str(alone)
    assert repr(alone).startswith("Comparison('overtaking', observers=('riccati',), variants=('nominal', 'v2x_loss')")
    assert "<pre" in alone._repr_html_() and "data:image/png;base64" in alone._repr_html_()
    with pytest.raises(CoopenvError, match=r"unknown observer 'ricati' \(did you mean 'riccati'\?\); known: Raises"):
        comparison["ricati"]


@pytest.mark.parametrize("kind", ["errors", "consistency", "variants", "cost"])
@pytest.mark.parametrize("width", [None, 3.5])
def test_figures_say_what_they_show(comparison: coopenv.Comparison, kind: str, width: float | None) -> None:
    figure = comparison.figure(kind, width=width)
    assert figure.get_figwidth() == (width or 10.5)
    shown = figure.get_supxlabel()
    assert "overtaking, seeds 3, 8" in shown and ("nominal" in shown) == (kind != "variants")
    figure.draw_without_rendering()
    words = [
        text.get_text() for ax in figure.axes for text in (*ax.texts, ax.title, ax.yaxis.label, *ax.get_yticklabels())
    ]
    assert "riccati" in words and ("Raises" in words) == (kind == "variants")
    if kind == "variants":
        assert {"better", "worse"} <= {figure.axes[1].get_xlabel(), figure.axes[1].get_title()}


def test_a_narrow_figure_states_how_many_vehicles_it_shows() -> None:
    found = compare("dead_reckoning", "busy_intersection", 1, overrides={"horizon": 0.5})
    assert "4 of 5 vehicles" in found.figure("errors", width=7.0).get_supxlabel()
    assert "vehicles" not in found.figure("errors", width=10.0).get_supxlabel()


def test_the_report_opens_with_the_worst_vehicle() -> None:
    found = compare("dead_reckoning", "busy_intersection_tracking", 1, overrides={"horizon": 1.2})
    worst = max(range(5), key=lambda i: found.rows[i].worst_after_start_m)
    assert _document(found)["first"] == worst != 0
    assert ".value = data.first" in page_file("charts.js").decode()


def test_mistakes(comparison: coopenv.Comparison, tmp_path: Path) -> None:
    for options, message in (
        ({"kind": "error"}, "did you mean 'errors'"),
        ({"variant": "v2x_delay"}, "was not run; there are nominal, v2x_loss"),
        ({"path": tmp_path / "figure.gif"}, "unknown format of a figure 'gif'"),
        ({"width": 0.1}, "expected 2 to 50 inches"),
    ):
        with pytest.raises(CoopenvError, match=message):
            comparison.figure(**options)
    with pytest.raises(CoopenvError, match="was not run"):
        comparison.table("v2x_delay")


def test_one_observer_needs_no_list() -> None:
    for one in ("dead_reckoning", DeadReckoning):
        assert len(compare(one, "busy_intersection_tracking", 1, overrides={"horizon": 1.0}).observers) == 1  # type: ignore[arg-type]
    both = compare("dead_reckoning, mekf", "busy_intersection_tracking", 1, overrides={"horizon": 1.0})
    assert both.observers == ("dead_reckoning", "mekf")


def makes() -> type:
    return type("Moved", (DeadReckoning,), {})


@pytest.mark.parametrize(
    ("observers", "options", "message"),
    [
        ("riccati,nosuch", {}, "unknown observer 'nosuch'"),
        (3, {}, "expected a name, a class or a list of them, got 3"),
        ([makes(), makes()], {}, "two observers are named 'Moved'"),
        ([3], {}, "expected a name"),
        (["riccati"], {"seeds": 0}, "at least one"),
        (["riccati"], {"seeds": [1, -1]}, "must not be negative"),
        (["riccati"], {"seeds": 2.5}, "whole number"),
        (["riccati"], {"overrides": {"horzon": 1.0}}, "did you mean 'horizon'"),
    ],
)
def test_mistakes_are_reported_before_the_work(
    monkeypatch: pytest.MonkeyPatch, observers: Any, options: dict[str, Any], message: str
) -> None:
    monkeypatch.setattr(registry, "_registered", {})
    with pytest.raises(CoopenvError, match=message):
        coopenv.compare(observers, "overtaking", **options)


def test_the_report_is_sorted_and_has_errors_beside_its_figures(comparison: coopenv.Comparison) -> None:
    text = report_text(comparison, {"command": "<command>", "versions": {"numpy": "2"}})
    places = [text.index(f'<td class="name">{name}</td>') for name in comparison.ranked]
    assert places == sorted(places)
    assert "&lt;command&gt;" in text and "<command>" not in text
    row = comparison.rows_in("nominal", "riccati")[0]
    value, error = with_error(row.position_rmse_m, row.position_rmse_se_m)
    assert f'{value}<span class="se"> ±&#8239;{error}</span>' in text
    assert "ZeroDivisionError" in text


def test_figures_have_the_width_and_font_of_a_column(comparison: coopenv.Comparison, tmp_path: Path) -> None:
    figure = comparison.figure("errors", width="ieee1", path=tmp_path / "errors.svg")
    assert figure.get_figwidth() == 3.5
    assert {text.get_fontfamily()[0] for text in figure.findobj(Text)} == {COLUMNS["ieee1"].font}
    assert "environment: overtaking" in (tmp_path / "errors.svg").read_text()
    with pytest.raises(CoopenvError, match="unknown width 'ieee3'"):
        comparison.figure("errors", width="ieee3")


# Sources


def test_a_log_file_gives_the_rows_of_what_it_recorded(tmp_path: Path) -> None:
    mcap = pytest.importorskip("mcap", reason="needs the extra log")
    assert mcap is not None
    from coopenv.sources.mcap import write_recording

    write_recording(record(coopenv.load_scenario("overtaking", {"horizon": 1.0}), 0), tmp_path / "drive.mcap")
    options: dict[str, Any] = {"variants": ["nominal", "v2x_delay"], "steady_from": 0.5}
    replay = compare(["mekf"], tmp_path / "drive.mcap", 3, **options)
    replayed = replay.rows
    simulated = compare(["mekf"], "overtaking", 1, overrides={"horizon": 1.0}, **options).rows
    assert (replay.environment, replay.seeds) == ("drive", (0,))
    assert [r.position_rmse_m for r in replayed] == [r.position_rmse_m for r in simulated]
    assert [r.bound_m for r in replayed] == [r.bound_m for r in simulated]


def test_variants() -> None:
    source = find_source("overtaking")
    assert variants_of(source, None) == ("nominal",) and variants_of(source, "all") == tuple(VARIANTS)
    assert variants_of(source, "v2x_loss, nominal,v2x_loss") == ("v2x_loss", "nominal")
    assert variants_of(find_source("mrclam_6"), None) == ("landmarks", "landmarks+robots", "blind")
    assert Plan.of("mekf", find_source("mrclam_6"), 3).work == "1 observer, 3 variants, 1 seed", "one record"


def test_observers_are_compared_where_they_are_meant_to_be() -> None:
    """Unless they are asked for by name."""

    def names(source: str, observers: str | None = None) -> tuple[str, ...]:
        return ObserverOptions(source=source, observers=observers).plan().observers

    assert names("mrclam_6_space") == names("mrclam_6") == names("overtaking")
    assert {"p3p", "robust", "self_calibrating"} <= {*names("overtaking")}
    with pytest.warns(DeprecationWarning, match="planar_ekf"):
        assert names("overtaking", "planar_ekf,mekf,mekf") == ("mekf_covariance", "mekf")


@pytest.mark.parametrize("name", ["mrclam_6", "mrclam_6_space"])
def test_recorded_robots_have_rows_without_a_bound(tmp_path: Path, name: str) -> None:
    mrclam_files.write(tmp_path, seconds=15.0)
    source = find_source(name, data=tmp_path)
    rows = compare(["dead_reckoning", "mekf"], name, data=tmp_path, variants=["landmarks", "blind"]).rows
    assert len(rows) == 2 * 2 * 5 and all(np.isnan(row.bound_m) and not row.failure for row in rows)
    assert all(np.isfinite([row.position_rmse_m, row.orientation_rmse_deg, row.ate_m]).all() for row in rows)
    # One record, judged from the start on: nothing was averaged over seeds, and nothing left out but the start itself.
    recording = source.recording("landmarks", 0)
    known = recording.truth.known & (recording.t > 0)[:, None]
    errors = run("dead_reckoning", recording).position_error
    expected = [np.sqrt(np.mean(errors[known[:, i], i] ** 2)) for i in range(5)]
    assert [row.position_rmse_m for row in rows[:5]] == pytest.approx(expected, rel=1e-12)
