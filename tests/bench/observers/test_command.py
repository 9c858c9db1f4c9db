"""The command: tables that fit, files with every column, a report that needs nothing else."""

from __future__ import annotations

import csv
import json
import re
from base64 import b64decode
from dataclasses import fields, replace
from gzip import decompress
from html.parser import HTMLParser
from importlib.metadata import EntryPoint
from itertools import product
from pathlib import Path

import numpy as np
import pytest

import coopenv
from coopenv.bench.observers import compare
from coopenv.bench.observers.command import figure_files, report_text
from coopenv.bench.observers.figures import PLOTLY, chart_data, page_file
from coopenv.bench.observers.judge import Series
from coopenv.bench.observers.rows import Row
from coopenv.bench.observers.tables import headline, quality
from coopenv.cli.app import main
from coopenv.observers import registry
from tests.bench.observers.test_comparison import SOURCE
from tests.helpers import mrclam_files
from tests.helpers.commands import refused
from tests.helpers.odd_observers import Raises

REQUIRED = {
    *("environment", "variant", "observer", "vehicle", "position_rmse_m", "orientation_rmse_deg", "bound_m", "anees"),
    *("settled_fraction", "settle_time_s", "bytes_per_s", "us_per_update", "failure"),
}


class Page(HTMLParser):
    """Collects what a page refers to, and whether its tags match."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.sources: list[str] = []
        self.anchors: list[str] = []
        self.places: list[str] = []
        self.open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attrs}
        self.sources += [given["src"]] if "src" in given else []
        self.anchors += [given["href"]] if "href" in given else []
        self.places += [f"#{given['id']}"] if "id" in given else []
        if tag not in ("meta", "img", "wbr"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files of a short comparison."""
    out = tmp_path_factory.mktemp("board") / "new"
    words = ["bench", "observers", "overtaking", "--observers", "riccati,mekf", "--variants", "nominal,landmarks_lost"]
    words += ["--seeds", "2", "--set", "horizon=1.0", "--basin", "2", "--jobs", "1", "--out", str(out)]
    assert main(words) == 0
    return out


@pytest.fixture(scope="module")
def comparison_of_two() -> coopenv.Comparison:
    return compare(["riccati", "mekf"], "overtaking", 2, overrides={"horizon": 1.0})


def test_json_and_csv(folder: Path) -> None:
    board = json.loads((folder / "leaderboard.json").read_text())
    assert set(board) == {"command", "versions", "seeds", "standard_errors_over", "rows", "windows", "basin"}
    assert set(board["versions"]) == {"coopenv", "numpy", "scipy", "warp-lang", "python"} and board["seeds"] == [0, 1]
    assert list(board["rows"][0]) == [f.name for f in fields(Row)] and set(board["rows"][0]) >= REQUIRED
    keys = [(row["variant"], row["observer"], row["vehicle"]) for row in board["rows"]]
    assert keys == [*product(("nominal", "landmarks_lost"), ("riccati", "mekf"), ("vehicle_1", "vehicle_2"))]
    assert [basin["observer"] for basin in board["basin"]] == ["riccati", "mekf"]
    with (folder / "leaderboard.csv").open() as file:
        found = [float(line["position_rmse_m"]) for line in csv.DictReader(file)]
    assert found == [row["position_rmse_m"] for row in board["rows"]]
    with (folder / "basin.csv").open() as file:
        assert len(list(csv.DictReader(file))) == 2 * 2 * 2


@pytest.mark.slow
def test_the_command_in_the_file_gives_the_same_table(folder: Path, tmp_path: Path) -> None:
    board = json.loads((folder / "leaderboard.json").read_text())
    words = board["command"].split()
    assert words[0] == "coopenv" and "--jobs" not in words
    assert main([*words[1:], "--jobs", "2", "--out", str(tmp_path)]) == 0
    again = json.loads((tmp_path / "leaderboard.json").read_text())
    for row in (*board["rows"], *again["rows"]):
        del row["us_per_update"]
    assert again == board


def test_report(folder: Path) -> None:
    text = (folder / "report.html").read_text()
    page = Page(text)
    assert not page.open
    headings = [place for place in page.places if f'<h2 id="{place[1:]}"' in text]
    assert [anchor for anchor in page.anchors if anchor in headings] == headings and len(headings) == 8
    assert not page.sources and text.count("<svg") == 1  # the basin
    assert len(text.encode()) < 2_000_000
    assert {*re.findall(r"url\(([^)]*)\)", text)} <= {*page.places}
    assert not re.search(r"(?:src|href)=.?http|@import", text)
    assert text.index('id="summary"') < text.index("ANEES") < text.index("</section>")
    assert all(f"<dt>{column.name}</dt>" in text for column in fields(Row))


def test_the_data_of_the_charts_are_those_of_the_samples(comparison_of_two: coopenv.Comparison) -> None:
    board = comparison_of_two
    data = json.loads(decompress(b64decode(chart_data(board))))
    assert data["observers"] == board.ranked and data["vehicles"] == ["vehicle_1", "vehicle_2"]
    (variant,) = data["variants"]
    own = board.samples_in("nominal")["mekf"]
    assert len(variant["t"]) == len(own[0].scene.t) == len(variant["curves"]["mekf"]["error"][1])
    error = np.median([sample.series.position_error[:, 1] for sample in own], axis=0)
    np.testing.assert_allclose(variant["curves"]["mekf"]["error"][1], error, rtol=6e-3)
    costs = {point["observer"]: point for point in data["cost"]}
    assert costs["mekf"]["rmse"] == board.totals["nominal", "mekf"].rmse.value
    assert costs["mekf"]["se"] == board.totals["nominal", "mekf"].rmse.error


def test_a_comparison_of_many_stays_below_two_megabytes(comparison_of_two: coopenv.Comparison) -> None:
    """Fifteen observers in eight variants, with curves of noise, which nothing packs well."""
    rng = np.random.default_rng(0)
    names, variants = [f"observer_{i}" for i in range(15)], {f"variant_{i}": "about" for i in range(8)}
    t = np.linspace(0.0, 50.0, 400)
    samples = []
    for variant in variants:
        for name in names:
            for sample in comparison_of_two.samples[:2]:
                scene = replace(sample.scene, t=t, bound=np.abs(rng.standard_normal((400, 2))))
                series = Series(*np.exp(rng.standard_normal((3, 400, 2))))
                samples.append(replace(sample, variant=variant, observer=name, scene=scene, series=series))
    many = replace(comparison_of_two, observers=tuple(names), variants=variants, samples=samples)
    text = report_text(many, {"command": "", "versions": {}})
    assert 700_000 < len(text.encode()) < 2_000_000


def test_quality_has_errors_over_the_seeds(comparison_of_two: coopenv.Comparison) -> None:
    found = quality(comparison_of_two, "nominal", "mekf")
    own = comparison_of_two.samples_in("nominal")["mekf"]
    sent = np.array([sample.measured("bytes_per_s").mean() for sample in own])
    assert found["sent"].value == pytest.approx(sent.mean())
    assert found["sent"].error == pytest.approx(sent.std(ddof=1) / np.sqrt(2))
    settled = [100 * np.isfinite(sample.measured("settle_time")).mean() for sample in own]
    assert found["settled"] == pytest.approx((np.mean(settled), np.std(settled, ddof=1) / np.sqrt(2)))
    best = headline(comparison_of_two)[0]
    assert best.startswith(f"Best of 2 in overtaking, seeds 0 to 1 (nominal): {comparison_of_two.ranked[0]}")
    assert " ± " in best


def test_plotly_is_the_published_bundle_with_its_licence() -> None:
    text = decompress(page_file(PLOTLY)).decode()
    assert "plotly.js (basic - minified) v4.1.1" in text[:200] and "MIT license" in text[:400]
    assert "MIT License" in page_file("plotly.LICENSE").decode()


def test_tables_fit_a_narrow_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "_registered", {})
    observers = ["covariance_intersection", Raises]
    text = str(compare(observers, "busy_intersection", 2, variants="all", overrides={"horizon": 1.0}))
    assert text.count("by design") == 1  # the same in every variant
    assert "failed" in text and "…" not in text and "bound (ancestors)" in text and "landmarks" in text
    assert max(len(line) for line in text.splitlines() if "by design" not in line) <= 80


def test_large_numbers_fit_as_well() -> None:
    """Results of an observer that diverges and broadcasts much."""
    comparison = compare(["covariance_intersection"], "overtaking", 1, overrides={"horizon": 0.5}, steady_from=0.2)
    (sample,) = comparison.samples
    wild = {"position_mse": 12345.6**2, "anees": 1.3e-11, "nis": 2814.3e3, "nis_dof": 1e3, "diverged": 1.0}
    wild |= {"bytes_per_s": 123456.7, "us_per_update": 12345.6}
    measures = {name: np.full((5, *old.shape[1:]), wild.get(name, 0.0)) for name, old in sample.measures.items()}
    scene = replace(sample.scene, vehicles=("a",) * 5, bounds=np.full((3, 5, 1), 1e-3), gramians=np.full((2, 5), 1e-3))
    samples = [replace(sample, scene=scene, measures=measures)] * 2
    text = str(replace(comparison, samples=samples, seeds=(0, 1)))
    assert "12346" in text and "…" not in text and max(len(line) for line in text.splitlines()) <= 80


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["overtaking", "--observers", "ricati"], "did you mean 'riccati'"),
        (["overtaking", "--engine", "dask"], "known are local, ray"),
        (["overtaking", "--address", "127.0.0.1:1"], "only --engine ray"),
        (["overtaking", "--engine", "ray", "--jobs", "2"], "the cluster decides"),
        (["overtaking", "--engine", "ray", "--address", "nowhere"], "expected HOST:PORT"),
        (["mrclam_6", "--set", "horizon=1"], "recorded"),
        (["mrclam_6", "--basin", "2"], "basins are studied in simulated environments"),
        (["mrclam_6", "--variants", "v2x_loss"], "known: landmarks, landmarks+robots, blind"),
        (["overtaking", "--variants", "blind"], "known: nominal"),
        (["overtaking", "--seeds", "0"], "'--seeds'"),
        (["overtaking", "--figures", "pdf"], "figures need a folder"),
        (["overtaking", "--figures", "gif", "--out", "x"], "known are png, pdf, svg"),
        (["overtaking", "--observers", "mekf", "--steady-from", "1000"], "not within the run"),
        (["crossing_path", "--observers", "mekf", "--variants", "lying_neighbour"], "no vehicle has another one"),
    ],
)
def test_mistakes_have_one_line(arguments: list[str], said: str) -> None:
    assert said in refused("bench", "observers", *arguments)


@pytest.mark.parametrize("start", ["nan", "-5", "99999", "inf"])
def test_the_steady_state_of_recorded_robots_lies_within_the_record(start: str, tmp_path: Path) -> None:
    mrclam_files.write(tmp_path, seconds=6.0)
    words = ("bench", "observers", "mrclam_6", "--data", str(tmp_path), "--observers", "mekf", "--jobs", "1")
    assert "not within the run" in refused(*words, "--steady-from", start)


def test_data_of_no_use_are_reported_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (mrclam_files.write(tmp_path, seconds=6.0) / "Robot5_Measurement.dat").write_text("")
    words = ["bench", "observers", "mrclam_6", "--data", str(tmp_path), "--observers", "mekf,dead_reckoning"]
    assert main([*words, "--jobs", "1"]) == 0
    assert capsys.readouterr().err.count("warning: mrclam_6: no detections of robot 5\n") == 1


def test_what_cannot_be_compared_is_left_out_with_its_reason(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A variant that a single vehicle cannot have, and a package's observer that cannot be loaded."""
    broken = {"broken": EntryPoint("broken", "no_such_module:Thing", "coopenv.observers")}
    monkeypatch.setattr(registry, "offered", lambda group: broken)
    short = ["--set", "horizon=0.1", "--seeds", "1", "--jobs", "1"]
    assert main(["bench", "observers", "crossing_path", "--variants", "all", *short]) == 0
    both = capsys.readouterr()
    left_out = {line.split()[2]: line for line in both.err.splitlines() if line.startswith("left out: ")}
    assert "no vehicle has another one as its neighbour" in left_out["lying_neighbour"]
    assert "no_such_module" in left_out["broken"]
    assert "nominal" in both.out and "lying" not in both.out and "mekf" in both.out and "broken" not in both.out
    told_now = refused("bench", "observers", "crossing_path", "--observers", "mekf,broken", *short)
    assert "'broken' (no_such_module:Thing) cannot be loaded" in told_now


def test_one_job_takes_an_observer_that_no_process_can_be_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    class Here(Raises):
        """Of this function alone."""

    monkeypatch.setattr(registry, "_registered", {})
    words = ["bench", "observers", "crossing_path", "--observers", f"{registry.named(Here)},dead_reckoning"]
    words += ["--set", "horizon=0.3", "--seeds", "1", "--jobs"]
    assert main([*words, "1"]) == 2
    assert "cannot be sent to another process" in refused(*words, "2")


def test_an_observer_in_a_file_and_figures_as_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures of another format go."""
    monkeypatch.setattr(registry, "_registered", {})
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text(SOURCE)
    words = ["bench", "observers", "overtaking", "--observers", "mine.py:Mine,dead_reckoning", "--seeds", "2"]
    words += ["--first", "7", "--set", "horizon=0.5", "--out", "board"]
    for form, start in (("pdf", b"%PDF"), ("svg", b"<?xml")):
        assert main([*words, "--figures", form, "--jobs", "1"]) == 0
        tables = {"leaderboard.json", "leaderboard.csv", "windows.csv", "leaderboard.tex", "report.html"}
        figures = {path.name for path in Path("board").iterdir()} - tables
        assert figures == {*figure_files(["nominal"], form)} - {f"variants.{form}", f"protection-nominal.{form}"}
        assert all((Path("board") / name).read_bytes().startswith(start) for name in figures)
    board = json.loads(Path("board/leaderboard.json").read_text())
    assert board["seeds"] == [7, 8] and "--observers mine.py:Mine,dead_reckoning" in board["command"]
    mine, other = (
        [row["position_rmse_m"] for row in board["rows"] if row["observer"] == name]
        for name in ("Mine", "dead_reckoning")
    )
    assert mine == other and len(mine) == 2


def test_json_on_standard_output_is_what_the_file_holds(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = "bench observers overtaking --observers dead_reckoning --seeds 1 --jobs 1 --set horizon=2.0 --steady-from 1"
    assert main([*words.split(), "--out", str(tmp_path / "board"), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed == json.loads((tmp_path / "board" / "leaderboard.json").read_text(encoding="utf-8"))
    assert [row["observer"] for row in printed["rows"]] == ["dead_reckoning"] * 2
