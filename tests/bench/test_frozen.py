"""The frozen benchmark: shipped rows are of the shipped scenes, and what differs is named in a result."""

from __future__ import annotations

import json
import math
from hashlib import sha256
from pathlib import Path
from shutil import copyfile
from typing import Any

import numpy as np
import pytest

from benchmarks import freeze
from coopenv.bench import frozen
from coopenv.bench.executors import Local
from coopenv.bench.frozen import Frozen, totals_of
from coopenv.cli.app import main
from coopenv.policies.base import played_back
from coopenv.policies.route_follower import RouteFollower
from coopenv.runs.recorder import record
from tests.helpers.commands import refused
from tests.helpers.short_benchmark import short_definition

MINE = Path(__file__).parents[2] / "examples" / "own_observer.py"


def test_the_shipped_rows_are_of_the_shipped_scenes() -> None:
    v1 = Frozen("v1")
    scenes = v1.scenes()
    assert len(scenes) == 30 and len([s for s in scenes if not s.source.policy.startswith("peek")]) == 20
    assert v1.zoo["comparable"] and v1.zoo["remarks"] == []
    assert {s.name: s.hash for s in scenes} == {name: scene["hash"] for name, scene in v1.zoo["scenes"].items()}
    filters = {"robust", "schmidt_kalman", "split_covariance_intersection", "mekf_covariance"}
    observers = filters | {"riccati", "dead_reckoning"}
    assert {(row["scene"], row["observer"]) for row in v1.zoo["rows"]} == {
        (s.name, o) for s in scenes for o in observers
    }
    assert not [row["failure"] for row in v1.zoo["rows"] if row["failure"]]


def in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Judge here, without the limits of observers, which `test_watched` is about."""
    monkeypatch.setattr(frozen, "Local", lambda jobs, limits: Local(jobs))


def test_an_own_observer_has_its_row_beside_the_zoo(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """In 3 s of two of the four seeds, which is another scene."""
    copyfile(MINE, tmp_path / "mine.py")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(Frozen, "definition", short_definition(2, 3.0))
    assert main(["bench", "v1", "mine.py:Ekf,dead_reckoning", "--scenes", "lane", "--jobs", "1"]) == 0
    table = capsys.readouterr().out
    result = json.loads((tmp_path / "bench_v1.json").read_text())
    other = "scene lane: its scenario is not the frozen one"
    assert result["remarks"] == ["29 scenes were left out", other] and not result["comparable"]
    assert f"Not comparable with the zoo's rows: 29 scenes were left out, {other}" in table
    assert "* Ekf" in table and "\nrobust" in table
    assert result["code"]["Ekf"] == sha256(MINE.read_bytes()).hexdigest() and "dead_reckoning" not in result["code"]
    rows = {row["observer"]: row for row in result["rows"]}
    for row in rows.values():
        assert row["bytes_per_s"] >= 0.0 < row["us_per_update"] and row["worst_m"] >= row["median_m"] > 0.0
        assert row["rmse_se_m"] > 0.0 and not row["failure"]
    assert rows["Ekf"]["rmse_m"] < 0.5 * rows["dead_reckoning"]["rmse_m"]


def test_driven_scenes_are_the_frozen_ones_whatever_drivers_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The rows of `dead_reckoning` are computed again: they are the shipped ones."""
    monkeypatch.chdir(tmp_path)
    in_this_process(monkeypatch)
    monkeypatch.setattr(RouteFollower, "speed", lambda self, observations, points=None: np.zeros(len(observations)))
    scenes = "facade,svea_crossing"
    assert main(["bench", "v1", "dead_reckoning", "--scenes", scenes, "--jobs", "1"]) == 0
    result = json.loads((tmp_path / "bench_v1.json").read_text())
    assert result["remarks"] == ["28 scenes were left out"]
    shipped = {(row["scene"], row["observer"]): row for row in Frozen("v1").zoo["rows"]}
    assert [row["scene"] for row in result["rows"]] == scenes.split(",")
    for again in result["rows"]:
        for key in ("rmse_m", "rmse_se_m", "worst_m", "anees_worst", "bound_m", "bytes_per_s"):
            assert again[key] == pytest.approx(shipped[again["scene"], again["observer"]][key], rel=1e-3), key
        assert again["rmse_se_m"] > 0.0


def test_differences_from_the_shipped_result_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = 'environment = "behind_truck", policy = "peek"'
    text = (frozen.FOLDER / "v1.toml").read_text()
    assert scene in text
    zoo = json.loads((frozen.FOLDER / "v1.json").read_text())
    zoo["scenes"]["svea_crossing"]["records"][0] *= 1.01
    copyfile(frozen.FOLDER / "v1_actions.npz", tmp_path / "v1_actions.npz")
    (tmp_path / "v1.toml").write_text(text.replace(scene, f"{scene}, set = {{ horizon = 2.0 }}"))
    (tmp_path / "v1.json").write_text(json.dumps(zoo))
    monkeypatch.setattr(frozen, "FOLDER", tmp_path)
    monkeypatch.chdir(tmp_path)
    in_this_process(monkeypatch)
    more = ["--jobs", "1", "--seconds", "99", "--json"]
    assert main(["bench", "v1", "dead_reckoning", "--scenes", "svea_crossing,behind_truck", *more]) == 0
    assert json.loads((tmp_path / "bench_v1.json").read_text())["remarks"] == [
        "v1.toml is not that of the shipped rows",
        "28 scenes were left out",
        "limits 99 s and 2048 MiB",
        "scene behind_truck: its scenario is not the frozen one",
        "scene svea_crossing: its records are not the frozen ones",
    ]


def test_actions_of_a_driver_are_played_back() -> None:
    """The present actions of `peek`, rounded, lead to their own record."""
    [scene] = Frozen("v1").scenes(["facade"])
    driver = freeze.Rounded(scene, 1000)
    first = record(driver.scenario, 1000, driver)
    second = record(driver.scenario, 1000, played_back(np.array(driver.taken, dtype=np.float64)))
    np.testing.assert_array_equal(first.truth.position, second.truth.position)


def test_mistakes_are_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert "unknown scene 'facad' (did you mean 'facade'?)" in refused("bench", "v1", "robust", "--scenes", "facad")
    assert "unknown observer 'robus'" in refused("bench", "v1", "robus")
    assert "no such file" in refused("bench", "v1", "none.py:Mine")
    assert "cannot write to no/file.json" in refused("bench", "v1", "robust", "--out", "no/file.json")


def row(scene: str, value: float | None, **more: Any) -> dict[str, Any]:
    numbers = {"rmse_m": value, "median_m": value, "worst_m": value, "rmse_se_m": value and 0.1 * value}
    costs = dict.fromkeys(("anees_median", "anees_worst", "bytes_per_s", "us_per_update"), 1.0)
    return {"scene": scene, "observer": "mine", **numbers, **costs, "failure": "", **more}


def test_totals_are_geometric_means_with_a_limit() -> None:
    """Of 0.1 m, 20 m that counts as 5 m, and a failure that counts likewise."""
    [total] = totals_of([row("a", 0.1), row("b", 20.0), row("c", None, failure="at 1 s")])
    assert total["rmse_m"] == pytest.approx((0.1 * 5.0 * 5.0) ** (1 / 3))
    assert total["rmse_se_m"] == pytest.approx(total["rmse_m"] * 0.1 / 3)
    assert (total["above"], total["failed"]) == (1, 1)
    [two] = totals_of([row("a", 0.1), row("b", 0.4)])
    assert two["rmse_m"] == pytest.approx(0.2) and two["rmse_se_m"] == pytest.approx(0.2 * 0.1 * math.sqrt(2) / 2)


def test_rows_that_measurements_do_not_make_possible_are_refused() -> None:
    """Below 0.9 of the bound and of all shipped rows, or with errors far too small for the stated covariance."""
    benchmark = Frozen("v1")
    shipped = [{**row, "observer": f"my_{row['observer']}"} for row in benchmark.zoo["rows"]]
    assert benchmark.refused(benchmark.zoo["rows"]) == {}
    assert {*benchmark.refused(shipped)} == {"my_riccati"}, "its matrix of gains is no covariance"
    possible = row("lane", 0.026, bound_m=0.0277)
    assert benchmark.refused([possible, row("ring", None, failure="at 1 s", bound_m=None)]) == {}
    assert benchmark.refused([possible, row("ring", 1e-9, bound_m=0.05)]) == {
        "mine": "mine refused: 1e-09 m in ring is below 0.045 m, 0.9 of the bound"
    }
    best = min(row["rmse_m"] for row in benchmark.zoo["rows"] if row["scene"] == "ring")
    [line] = benchmark.refused([row("ring", 1e-9, bound_m=2.0 * best)]).values()
    assert line.endswith(f"is below {0.9 * best:.2g} m, 0.9 of the best shipped row")
    assert benchmark.refused([{**possible, "anees_median": 0.01}]) == {
        "mine": "mine refused: ANEES 0.01 is below 0.16: state a smaller covariance, or none"
    }


def test_a_refused_row_is_one_line_and_stands_in_no_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    why = "Mine refused: 1e-09 m in lane is below 0.025 m, 0.9 of the bound"
    scenes = Frozen("v1").zoo["scenes"]
    result = {"rows": [], "refused": {"Mine": why}, "totals": [], "remarks": [why], "scenes": scenes}
    monkeypatch.setattr(Frozen, "run", lambda *given: result)
    monkeypatch.chdir(tmp_path)
    assert main(["bench", "v1", "robust"]) == 2
    printed = capsys.readouterr()
    assert printed.err.endswith(f"error: {why}\n") and printed.out.count("Mine") == 1


def test_an_observer_that_fails_alike_in_many_scenes_has_one_line() -> None:
    benchmark = Frozen("v1")
    scenes = list(benchmark.zoo["scenes"])
    late = [row(name, None, bound_m=None, failure="with seed 1000: more than 120 s (--seconds)") for name in scenes[1:]]
    other = row(scenes[0], None, bound_m=None, failure="at vehicle_2 at 3.000 s: KeyError: 3 (mine.py:9)")
    result = {"rows": [other, *late], "scenes": benchmark.zoo["scenes"], "remarks": []}
    lines = [part for part in frozen.report(benchmark, result) if isinstance(part, str) and "failed " in part]
    assert lines == [
        f"mine ({scenes[0]}): failed at vehicle_2 at 3.000 s: KeyError: 3 (mine.py:9)",
        f"mine ({', '.join(scenes[1:4])}, ... (29 in all)): failed with seed 1000: more than 120 s (--seconds)",
    ]
