"""Runs and evaluations in Python, printed and as tables of other programs."""

from __future__ import annotations

import builtins
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas
import polars
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

import coopenv
from coopenv.base.columns import Columns
from coopenv.base.installation import load_reference
from coopenv.bench.cards import KINDS
from coopenv.cli.app import main
from coopenv.estimation.trajectory import Trajectory
from coopenv.runs.command import Results
from tests.helpers.four_way import FOUR_WAY

SHORT = {"horizon": 1.0}


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Results:
    out = tmp_path_factory.mktemp("runs") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("coopenv.viz.figures.FIGURE_NAMES", ("topology",))
        return coopenv.run(FOUR_WAY, seed=2, observer="robust", overrides=SHORT, steady_from=0.5, out=out)


def test_a_run_in_python_is_that_of_the_shell(results: Results, tmp_path: Path, capsys: Any) -> None:
    arguments = ["--seed", "2", "--observer", "robust", "--set", "horizon=1.0", "--steady-from", "0.5"]
    assert main(["run", FOUR_WAY, *arguments, "--no-figures", "--out", str(tmp_path / "run")]) == 0
    assert str(results) in capsys.readouterr().out
    again = Results.read(tmp_path / "run")
    for name in Trajectory.kinds():
        assert_array_equal(getattr(again.trajectory, name), getattr(results.trajectory, name))
    assert str(again) == str(results)
    assert {path.name for path in results.files} == {path.name for path in results.files[0].parent.iterdir()}
    kept = coopenv.run(results.scenario or FOUR_WAY, seed=2, steps=3)  # with its observer, and no files
    assert kept.files == () and kept.metrics["observer"] == "robust"


def test_a_run_prints_itself(results: Results, tmp_path: Path) -> None:
    assert repr(results).startswith("Results('four_way', observer='robust', policy='zero', seed=2, outcome=")
    assert "RMSE" in str(results) and "vehicle_4" in str(results)
    html, nan = results._repr_html_(), np.full_like(results.trajectory.position, np.nan)
    assert "RMSE" in html and "data:image/png;base64," in html
    results.figure("topology", path=tmp_path / "topology.svg")
    assert "four_way" in (tmp_path / "topology.svg").read_text()
    assert repr(results.trajectory) == f"Trajectory('0 to 1 s', ticks=61, vehicles=4, targets={4 + landmarks()})"
    html = results.trajectory._repr_html_()
    assert "<td>float64 (61, 4, 3)</td>" in html and "data:image/png;base64," in html
    assert "<img" not in replace(results.trajectory, position=nan)._repr_html_()  # without truth


def landmarks() -> int:
    return len(coopenv.load_scenario(FOUR_WAY).landmarks)


def test_a_trajectory_is_a_long_table(results: Results) -> None:
    frame, of = results.to_pandas(), results.trajectory
    assert len(frame) == of.position_error.size
    one = frame[frame.vehicle == "vehicle_3"]
    assert_array_equal(one.t_s, of.t)
    assert_array_equal(one[["x_m", "y_m", "z_m"]], of.position[:, 2])
    assert_array_equal(one.targets_in_view, of.visible[:, 2].sum(axis=-1))
    angles = Rotation.from_euler("ZYX", one[["yaw_estimate_deg", "pitch_estimate_deg", "roll_estimate_deg"]], True)
    assert_allclose(angles.as_matrix(), of.rotation_estimate[:, 2], atol=1e-9)
    assert_array_equal(one["reward_progress"], of.reward_terms[:, 2, list(of.terms).index("progress")])
    assert {name: frame.attrs["units"][name] for name in ("x_m", "yaw_deg", "nees", "velocity_x_m_per_s")} == {
        "x_m": "m",
        "yaw_deg": "deg",
        "nees": "1",
        "velocity_x_m_per_s": "m/s",
    }
    data = results.to_xarray()
    assert_array_equal(data["position_error_m"], of.position_error)
    assert data["position_error_m"].attrs == {"units": "m"} and list(data.vehicle.values) == of.vehicles.tolist()
    assert_array_equal(polars.DataFrame(results)["nees"], frame["nees"])


def test_a_result_is_iterated_by_what_it_is_indexed_with(results: Results) -> None:
    vehicles = results.trajectory.vehicles.tolist()
    for found in (results, results.trajectory):
        assert len(found) == len(vehicles) and [*found] == vehicles and "nosuch" not in found
        assert all(found[name].vehicles.tolist() == [name] for name in found)
        with pytest.raises(
            coopenv.CoopenvError, match=rf"^{type(found).__name__} is not an array: to_pandas\(\) returns"
        ):
            pandas.DataFrame(found)


def test_the_spread_is_that_of_infos() -> None:
    """Against the kernel, and against draws of the error through the exact map from body to map frame."""
    env = coopenv.parallel_env("urban_crossing", dtype="float64")
    _, infos = env.reset(seed=3)
    for _ in range(3):
        *_, infos = env.step({agent: env.action_space(agent).sample() for agent in env.agents})
    for info in infos.values():
        P = coopenv.position_covariance(**info["estimate"])
        assert np.sqrt(np.trace(P)) == pytest.approx(info["position_std"], rel=1e-6)
        rotation, position = (np.array(info["estimate"][name]) for name in ("rotation", "position"))
        small = 1e-6 * np.random.default_rng(1).multivariate_normal(np.zeros(6), info["estimate"]["covariance"], 20_000)
        turned = rotation @ Rotation.from_rotvec(small[:, :3]).as_matrix()
        moved = (turned @ (rotation.T @ position + small[:, 3:])[..., None])[..., 0] - position
        assert_allclose(np.cov(1e6 * moved.T), P, atol=0.05 * np.trace(P))


@pytest.mark.parametrize("form", ["csv", "parquet"])
def test_a_run_is_exported(results: Results, form: str, capsys: Any) -> None:
    folder = results.files[0].parent
    assert main(["export", str(folder), "--format", form]) == 0
    path = folder / f"trajectory.{form}"
    assert str(path) in capsys.readouterr().out
    frame = results.to_pandas()
    if form == "csv":
        read = pandas.read_csv(path)
        pandas.testing.assert_frame_equal(read, frame.replace([np.inf], np.nan), check_dtype=False, check_exact=False)
    else:
        read = pandas.read_parquet(path)
        pandas.testing.assert_frame_equal(read, frame)
        assert read.attrs == frame.attrs
        assert polars.read_parquet(path).columns == list(frame.columns)


def test_a_missing_package_is_one_line(results: Results, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    load = builtins.__import__

    def without(name: str, *rest: Any) -> Any:
        if name.split(".")[0] in ("pandas", "polars", "xarray", "pyarrow"):
            raise ImportError(f"No module named '{name}'")
        return load(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    for method in ("to_pandas", "to_polars", "to_xarray"):
        with pytest.raises(coopenv.CoopenvError, match=rf"{method[3:]} needs .*pip install '\.\[tables\]'"):
            getattr(results, method)()
    with pytest.raises(coopenv.CoopenvError, match=r"pip install '\.\[tables\]'"):
        results.to_parquet(tmp_path / "x.parquet")
    assert not list(tmp_path.iterdir())


def test_columns_are_in_the_order_of_the_rows() -> None:
    table = Columns({"name": ["b", "a"], "way_m": np.array([1.0, np.inf]), "count": [1, 2]}, ("name",))
    assert table.csv() == "name,way_m,count\nb,1.0,1\na,,2\n"
    assert table.units == {"way_m": "m", "count": "1"}


def test_an_evaluation_in_python(capsys: Any, tmp_path: Path) -> None:
    scenario = coopenv.load_scenario("facade", {"horizon": 3.0})
    found = coopenv.evaluate(scenario, ["peek", "route_follower"], worlds=3)
    assert main(["evaluate", "facade", "--agents", "peek,route_follower", "--worlds", "3", "--set", "horizon=3.0"]) == 0
    printed = capsys.readouterr().out.replace("facade:", "Facade:")
    assert "Facade: 3 held-out worlds" in printed and "e95\n" not in printed
    assert repr(found) == "Evaluation('Facade', agents=('peek', 'route_follower'), worlds=3)"
    assert "held-out worlds" in (html := found._repr_html_()) and "data:image/png;base64," in html
    assert all(":" in place and callable(load_reference(place)) for place in KINDS.values())  # before `evaluate` loads
    found.figure("looking", width="ieee1", path=tmp_path / "looking.pdf")
    assert (tmp_path / "looking.pdf").is_file()
    with pytest.raises(coopenv.CoopenvError, match=r"unknown figure 'look'.* known: error_along_the_way"):
        found.figure("look")
    data = found.to_xarray()
    for row in found.rows:
        assert float(data["mean"].sel(agent=row["agent"], metric=row["metric"])) == pytest.approx(
            row["mean"], nan_ok=True
        )
    assert found.to_pandas().attrs["units"] == {"n": "1"} and not data["mean"].attrs
    assert dict(zip(found.to_pandas().metric, found.to_pandas().unit, strict=True))["e95_m"] == "m"
    with pytest.raises(coopenv.CoopenvError, match=r"^unknown agent 'nosuch'"):
        coopenv.evaluate("facade", "nosuch")
