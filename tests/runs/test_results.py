"""Results: written by commands that may be killed, read again, drawn anew and exported."""

from __future__ import annotations

import dataclasses
import json
import shutil
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from coopenv.base import files
from coopenv.cli.app import main
from coopenv.estimation.metrics import absolute_error, relative_error
from coopenv.estimation.trajectory import Trajectory
from coopenv.runs.command import Results
from coopenv.runs.exports import write_tum
from tests.helpers.commands import refused
from tests.helpers.synthetic import make_trajectory


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("run") / "overtaking"
    words = ["run", "overtaking", "--seed", "2", "--set", "horizon=2.0", "--set", "observer.name=robust"]
    assert main([*words, "--no-figures", "--out", str(out)]) == 0
    return out


def test_a_run_is_read_again(folder: Path) -> None:
    results = Results.read(folder)
    assert results.metrics["observer"] == "robust" and results.metrics["seed"] == 2
    assert results.trajectory.vehicles.tolist() == ["vehicle_1", "vehicle_2"]
    assert np.isnan(results.ends).all() and results.steady_from == pytest.approx(1.4)
    scenario = results.scenario
    assert scenario is not None and scenario.observer.name == "robust" and scenario.horizon == 2.0


@pytest.mark.parametrize("arguments", [[], ["--format", "svg", "--width", "ieee1"]])
def test_figures_are_drawn_anew_and_say_of_what_they_are(
    arguments: list[str],
    folder: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("coopenv.viz.figures.FIGURE_NAMES", ("errors", "topology"))
    assert main(["figures", str(folder), *arguments, "--out", str(tmp_path / "new")]) == 0
    form = "svg" if arguments else "pdf"
    assert {path.name for path in (tmp_path / "new").iterdir()} == {f"errors.{form}", f"topology.{form}"}
    text = (tmp_path / "new" / f"errors.{form}").read_bytes().decode("latin-1")
    assert "environment: overtaking; observer: robust; seed: 2" in text
    if arguments:
        assert 'width="252pt"' in text  # 3.5 in
        assert "seed 2</text" not in text and "overtaking, robust" not in text
    assert "errors" in capsys.readouterr().out


def test_trajectories_are_exported(folder: Path, tmp_path: Path) -> None:
    assert main(["export", str(folder), "--format", "tum", "--out", str(tmp_path / "tum")]) == 0
    rows = np.loadtxt(tmp_path / "tum" / "vehicle_2_estimate.tum")
    trajectory = Results.read(folder).trajectory
    np.testing.assert_allclose(rows[:, 1:4], trajectory.position_estimate[:, 1], atol=1e-9)


def test_what_is_no_run_is_one_line(folder: Path, tmp_path: Path) -> None:
    def said(change: str) -> str:
        return refused("figures", str(tmp_path / change))

    assert said("nothing").endswith(f"no such run: {tmp_path / 'nothing'}\n")
    assert "no folder of `coopenv run` (metrics.json: No such file" in said("")
    for name, text, why in (
        ("text", "hello", "metrics.json: not JSON"),
        ("list", "[]", "not of a run, missing: environment, seed"),
        ("empty", "{}", "not of a run, missing: environment, seed"),
    ):
        (tmp_path / name).mkdir()
        (tmp_path / name / "metrics.json").write_text(text)
        assert why in said(name)
    shutil.copytree(folder, tmp_path / "other")
    metrics = json.loads((folder / "metrics.json").read_text())
    metrics["vehicles"][0]["vehicle"] = "vehicle_9"
    (tmp_path / "other" / "metrics.json").write_text(json.dumps(metrics))
    assert "vehicles differ from trajectory.npz's" in said("other")
    (tmp_path / "other" / "trajectory.npz").write_text("no archive")
    assert "trajectory.npz: not a readable trajectory" in said("other")
    whole = (folder / "trajectory.npz").read_bytes()
    for broken in (whole[:300], whole[: len(whole) // 2], whole[:400] + bytes(400) + whole[800:]):
        (tmp_path / "other" / "trajectory.npz").write_bytes(broken)
        assert "trajectory.npz: not a readable trajectory: it is cut off, damaged" in said("other")
    with np.load(folder / "trajectory.npz") as data:
        arrays = dict(data)
    for change, why in (
        ({"nees": np.zeros(3)}, r"trajectory.npz: nees: float64 (3,) is not of kind f and shape ("),
        ({"position": arrays["position"].astype(np.complex64)}, "position: complex64"),
        ({"sight": arrays["sight"][:-1]}, "sight: uint8"),
        ({"t": arrays["t"] * np.nan}, "t: expected finite times, s, in order"),
        ({"t": arrays["t"][::-1]}, "t: expected finite times, s, in order"),
        ({"vehicles": np.array([{}] * len(arrays["vehicles"]), object)}, "vehicles: object"),
    ):
        np.savez(tmp_path / "other" / "trajectory.npz", allow_pickle=True, **{**arrays, **change})
        assert why in said("other")
    arrays.pop("protection_level")  # as of older versions
    np.savez(tmp_path / "older.npz", **arrays)
    assert np.isinf(Trajectory.load(tmp_path / "older.npz").protection_level).all()
    arrays.pop("nees")
    np.savez(tmp_path / "other" / "trajectory.npz", **arrays)
    assert "trajectory.npz: not a trajectory, missing: nees" in said("other")
    (tmp_path / "other" / "trajectory.npz").unlink()
    assert "trajectory.npz: not a readable trajectory (No such file or directory)" in said("other")
    shutil.copy(folder / "trajectory.npz", tmp_path / "other")
    with zipfile.ZipFile(tmp_path / "other" / "trajectory.npz", "a") as archive:
        archive.writestr("more.npy", b"")
        archive.filelist[-1].file_size = 2**31  # of a file of zeros
    tracemalloc.start()
    assert "trajectory.npz: unpacks to more than 2 GiB" in said("other")
    assert tracemalloc.get_traced_memory()[1] < 20e6
    tracemalloc.stop()
    assert "metrics.json: a file; expected a folder that `coopenv run` has written" in said("other/metrics.json")


def test_a_line_is_a_pose(tmp_path: Path) -> None:
    run = make_trajectory(ticks=121, noise=0.02, yaw_rate=0.3)
    gone = run.position_estimate.copy()
    gone[50:60, 1] = np.nan
    run = dataclasses.replace(run, position_estimate=gone)
    paths = write_tum(run, tmp_path / "tum")
    assert [path.name for path in paths[:2]] == ["vehicle_1_truth.tum", "vehicle_1_estimate.tum"]
    assert len(paths) == 10
    rows = np.loadtxt(paths[1])
    np.testing.assert_allclose(rows[:, 0], run.t, atol=1e-9)
    np.testing.assert_allclose(rows[:, 1:4], run.position_estimate[:, 0], atol=1e-9)
    turned = Rotation.from_quat(rows[:, 4:]).as_matrix()
    np.testing.assert_allclose(turned, run.rotation_estimate[:, 0], atol=1e-8)
    assert len(np.loadtxt(paths[3])) == 111


def test_evo_measures_the_same_errors(tmp_path: Path) -> None:
    pytest.importorskip("evo", reason="needs the extra 'dev'")
    from evo.core import metrics, sync
    from evo.tools import file_interface

    run = make_trajectory(ticks=301, noise=0.05)
    truth, estimate, *_ = write_tum(run, tmp_path)
    reference, found = (file_interface.read_tum_trajectory_file(str(path)) for path in (truth, estimate))
    pair = sync.associate_trajectories(reference, found)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data(pair)
    np.testing.assert_allclose(ape.error, run.position_error[:, 0], atol=1e-7)
    turn = metrics.APE(metrics.PoseRelation.rotation_angle_deg)
    turn.process_data(pair)
    np.testing.assert_allclose(turn.error, run.orientation_error[:, 0], atol=1e-5)
    whole = absolute_error(run.position[:, 0], run.position_estimate[:, 0])
    assert whole == pytest.approx(ape.get_statistic(metrics.StatisticsType.rmse), rel=1e-6)
    poses = (run.rotation, run.position, run.rotation_estimate, run.position_estimate)
    own = relative_error(*(part[:, 0] for part in poses), delta=7)
    for value, relation in zip(own, ("translation_part", "rotation_angle_deg"), strict=True):
        rpe = metrics.RPE(metrics.PoseRelation[relation], 7, metrics.Unit.frames)
        rpe.process_data(pair)
        assert value == pytest.approx(rpe.get_statistic(metrics.StatisticsType.rmse), rel=1e-5)


class Ended(BaseException):
    """Stand-in for a kill of a command."""


SHORT = ["overtaking", "--set", "horizon=0.5"]
BENCH = ["bench", "observers", *SHORT, "--observers", "riccati", "--variants", "nominal", "--jobs", "1"]


@pytest.mark.parametrize(
    "command",
    [
        ["run", *SHORT, "--out", "result", "--seed"],
        ["record", *SHORT, "--out", "result.mcap", "--force", "--seed"],
        [*BENCH, "--out", "result", "--seeds"],
    ],
    ids=lambda words: words[0],
)
def test_a_command_that_is_ended_leaves_the_earlier_result(
    command: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Kills at random instants are those of tests/test_files.py."""

    def contents() -> dict[str, bytes]:
        return {str(path): path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}

    def ended(path: Path) -> None:
        raise Ended

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("coopenv.viz.figures.FIGURE_NAMES", ("topology",))
    assert main([*command, "1"]) == 0
    first = contents()
    with monkeypatch.context() as patched, pytest.raises(Ended):
        patched.setattr(files, "sync", ended)  # all is written, and nothing is in its place yet
        main([*command, "2"])
    assert contents() == first
    assert main([*command, "2"]) == 0
    assert contents().keys() == first.keys() and contents() != first
