"""Parts of recorded data, by time and robots, and recordings as objects: one result whichever way they are given."""

from __future__ import annotations

import gzip
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import coopenv
from coopenv import CoopenvError, DataError
from coopenv.base.errors import DataWarning
from coopenv.bench.observers import compare
from coopenv.cars.bags.topic_map import load_map
from coopenv.cli.app import main
from coopenv.observers import Recording, run
from coopenv.observers.recording import check_recording
from coopenv.observers.sensed import Truth
from coopenv.sources.mcap import write_recording
from coopenv.sources.selection import Selection
from coopenv.sources.sources import is_recording, open_recording
from coopenv.sumo import files as sumo_files
from tests.helpers import mrclam_files
from tests.helpers.recordings import simulated


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    parent = tmp_path_factory.mktemp("data")
    mrclam_files.write(parent, seconds=12.0)
    return parent


@pytest.fixture(scope="module")
def whole(data: Path) -> Recording:
    return open_recording("mrclam_6", data)


def part(whole: Recording, start: Any = None, until: Any = None, robots: Any = None) -> Recording:
    found = Selection.of(start, until, robots).applied(whole, "drive")
    check_recording(found, "part")
    return found


@pytest.mark.parametrize("source", ["robots", "simulated"])
def test_a_stretch_has_the_same_ticks_and_errors_of_the_start(whole: Recording, source: str) -> None:
    recording = whole if source == "robots" else simulated("busy_intersection", v2x__period=3)
    first = 42 if source == "robots" else 15  # of multiples of the period
    dt = recording.dt
    found = part(recording, (first - 0.5) * dt, (first + 20) * dt)
    assert found.ticks == 21
    cut = slice(first, first + 21)
    assert_array_equal(found.bearings, recording.bearings[cut])
    assert_array_equal(found.truth.position, recording.truth.position[cut])
    assert_array_equal(found.rotation[1:], recording.rotation[cut][1:])
    assert_array_equal(found.rotation[0], np.broadcast_to(np.eye(3), found.rotation[0].shape))
    for i in range(len(found.setups)):
        errors = [
            (R.T @ r.start_rotation[i], R.T @ (r.start_position[i] - r.truth.position[0, i]))
            for r in (recording, found)
            for R in [r.truth.rotation[0, i]]
        ]
        assert_allclose(errors[1][0], errors[0][0], atol=1e-12)
        assert_allclose(errors[1][1], errors[0][1], atol=1e-12)
    assert not run("mekf", found).failure


def test_robots_that_are_left_out_have_no_part(whole: Recording, data: Path) -> None:
    found = part(whole, robots="1,3")
    assert found.left_out.tolist() == [False, True, False, True, True]
    assert found.setups[0].targets.tolist() == [0, 1, 2, 3, 4, 7]
    assert not found.visible[:, [1, 3, 4]].any() and not found.visible[..., [6, 8, 9]].any()
    assert not np.isfinite(found.truth.position[:, [1, 3, 4]]).any()
    board = compare(["mekf_covariance"], "mrclam_6", data=data, robots=[3, 1], variants=["landmarks"])
    assert [row.vehicle for row in board.rows] == ["vehicle_1", "vehicle_3"] and "Not judged" not in str(board)


def test_bounds_are_those_of_the_robots_that_are_left() -> None:
    recording = simulated()
    rows = compare(["mekf"], recording, robots=[1, 2]).rows
    assert [row.vehicle for row in rows] == ["vehicle_1", "vehicle_2"]
    assert all(np.isfinite([row.bound_m, row.bound_ancestors_m]).all() for row in rows)


def test_a_recording_is_taken_as_an_object(whole: Recording, tmp_path: Path) -> None:
    recording = simulated()
    write_recording(recording, tmp_path / "log.mcap")
    by_object, by_name = (coopenv.compare(["mekf"], source) for source in (recording, tmp_path / "log.mcap"))
    assert [r.position_rmse_m for r in by_object.rows] == [r.position_rmse_m for r in by_name.rows]
    result = coopenv.run(part(whole, until=2.0), observer="riccati", steady_from=1.0)
    assert result.metrics["environment"] == "recording" and len(result.metrics["vehicles"]) == 5
    assert coopenv.parallel_env(recording).possible_agents == [setup.name for setup in recording.setups]
    for options in ({"data": tmp_path}, {"topics": "x.toml"}, {"overrides": {"horizon": 1.0}}):
        with pytest.raises(CoopenvError, match="a Recording was given"):
            coopenv.compare(["mekf"], recording, **options)


def test_the_commands_take_a_part(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = ["mrclam_6", "--data", str(data), "--from", "2", "--until", "4", "--robots", "vehicle_2,4"]
    assert main(["run", *given, "--no-figures", "--out", str(tmp_path / "out"), "--observer", "riccati"]) == 0
    printed = capsys.readouterr().out
    assert "vehicle_1, vehicle_3, vehicle_5: left out" in printed and "horizon reached at 2 s" in printed
    bench = ["bench", "observers", *given, "--observers", "mekf_covariance", "--jobs", "1"]
    assert main([*bench, "--variants", "landmarks", "--seeds", "3", "--out", str(tmp_path / "board")]) == 0
    printed, warned = capsys.readouterr()
    assert "f2" in printed and "f1" not in printed
    assert "mrclam_6: one recording, in which seeds draw nothing" in warned
    assert "--from 2.0 --until 4.0 --robots vehicle_2,4" in (tmp_path / "board" / "leaderboard.json").read_text()


@pytest.mark.parametrize(
    ("options", "line"),
    [
        ((9.0, 3.0, None), "until: 3 s are not after the start at 9 s"),
        ((-1.0, None, None), "from: expected a time of at least 0 s, got -1"),
        ((None, None, ""), "robots: expected names or numbers such as 1,3, got ''"),
        ((None, None, 1.5), "drive: robots: unknown robot '1.5'"),
        ((None, 0.01, None), "drive: until: 0.01 s; 11.35 s are recorded, in steps of 0.05 s"),
        ((None, None, [9]), "drive: robots: unknown robot 'vehicle_9'.* known: vehicle_1, vehicle_2"),
    ],
)
def test_a_part_that_there_is_not_is_one_line(whole: Recording, options: tuple[Any, ...], line: str) -> None:
    with pytest.raises(CoopenvError, match=line):
        Selection.of(*options).applied(whole, "drive")


def test_a_start_without_a_true_pose_is_refused_with_the_next_time(whole: Recording) -> None:
    unknown = part(whole)
    truth = [np.array(values) for values in (unknown.truth.rotation, unknown.truth.position)]
    truth[1][40:60, 2] = np.nan
    with pytest.raises(DataError, match=r"not known at 2\.5 s; they are at 3 s"):
        part(replace(whole, truth=Truth(*truth)), 2.5)
    assert part(replace(whole, truth=Truth(*truth)), 2.5, robots="1,2").ticks


def test_faults_of_the_scenario_are_those_of_the_whole(tmp_path: Path) -> None:
    lie = {"faults__lie__kind": "jump", "faults__lie__start": 0.6}
    write_recording(simulated(**lie), tmp_path / "log.mcap")
    read = open_recording(tmp_path / "log.mcap")
    with pytest.raises(DataError, match="from: its scenario has faults, whose times count from its own start"):
        coopenv.run(tmp_path / "log.mcap", start=0.3)
    errors = [[r.position_rmse_m for r in compare(["mekf"], source).rows] for source in (tmp_path / "log.mcap", read)]
    assert errors[0] == errors[1] != [r.position_rmse_m for r in compare(["mekf"], simulated()).rows]


def test_simulations_have_no_parts() -> None:
    with pytest.raises(CoopenvError, match="from is for recorded data, 'overtaking' is simulated"):
        coopenv.run("overtaking", start=1.0)
    with pytest.raises(CoopenvError, match=r"--until 2\.0: is for recorded data, overtaking is simulated"):
        coopenv.compare(["mekf"], "overtaking", until=2.0)


def test_seeds_of_one_recording_are_mentioned(whole: Recording) -> None:
    with pytest.warns(DataWarning, match="recording: one recording, in which seeds draw nothing"):
        compare(["riccati"], part(whole, until=1.0), 3)


def arrays_of(recording: Recording) -> dict[str, Any]:
    """Return the arguments of `Recording.from_arrays` that give a recording of standing landmarks again."""
    names = ("velocity", "angular_velocity", "bearings", "start_position", "start_rotation", "dt", "period")
    truth = {"truth_position": recording.truth.position, "truth_rotation": recording.truth.rotation}
    given = {name: getattr(recording, name) for name in names}
    return {**given, **truth, "landmarks": recording.landmarks[0], "noise": recording.setups[0].noise}


def test_a_recording_is_made_of_arrays(whole: Recording) -> None:
    made = Recording.from_arrays(**arrays_of(whole))
    assert [setup.name for setup in made.setups] == [setup.name for setup in whole.setups]
    for name in ("rotation", "translation", "visible", "inbox_tick", "start_covariance"):
        assert_allclose(getattr(made, name), getattr(whole, name), atol=1e-3, err_msg=name)
    rows = coopenv.compare(["mekf"], made).rows
    assert len(rows) == 5 and all(row.position_rmse_m < 0.05 and not row.failure for row in rows)
    short = {name: np.asarray(values)[:3] for name, values in arrays_of(whole).items() if "truth" in name}
    first = {"start_position": None, "start_rotation": None}
    assert_array_equal(Recording.from_arrays(**(arrays_of(whole) | first)).start_position, short["truth_position"][0])
    derived = type("Derived", (Recording,), {}).from_arrays(**arrays_of(whole))
    assert is_recording(derived) and not is_recording("mrclam_6")


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"velocity": np.zeros((4, 3))}, r"velocity: expected K N 3, got shape \(4, 3\)"),
        ({"velocity": np.zeros((1, 5, 3))}, "velocity: expected K N 3, K > 1"),
        ({"angular_velocity": np.zeros((9, 5, 3))}, r"angular_velocity: expected K N 3 = \(228, 5, 3\), got \(9, 5"),
        ({"bearings": np.full((228, 5, 10, 3), 0.7)}, "recording: bearings of vehicle_1, tick 0: not unit vectors"),
        ({"velocity": np.full((228, 5, 3), np.nan)}, r"velocity: not finite at \[\[0, 0, 0\]\]"),
        ({"truth_position": 3.0}, r"truth_position: expected K N 3 = \(228, 5, 3\), got \(\)"),
        ({"landmarks": [["a", 1, 2]]}, "landmarks: not an array of numbers"),
        ({"dt": 0.0}, "dt: 0.0 is not in 1e-05"),
        ({"start_position": None, "truth_position": None}, "start_position: needed, as the first true one is"),
        ({"truth_rotation": np.full((228, 5, 3, 3), 57.3)}, "recording: truth.rotation of vehicle_1, tick 0"),
        ({"start_std": (0.0, 0.0)}, "start_std: expected two positive numbers"),
        ({"dt": "0.1"}, "dt: expected .*, got '0.1'"),
        ({"period": 1.5}, "period: expected .*, got 1.5"),
        ({"noise": None}, "noise: expected .*SensorNoise.*, got None"),
        ({"landmarks": np.zeros((0, 3))}, r"bearings: expected K N T 3 = \(228, 5, 5, 3\), got"),
    ],
)
def test_arrays_that_do_not_fit_are_one_line(whole: Recording, change: dict[str, Any], line: str) -> None:
    with pytest.raises(DataError, match=line):
        Recording.from_arrays(**(arrays_of(whole) | change))


def test_arrays_with_a_truth_in_another_frame_are_noticed(whole: Recording) -> None:
    given = arrays_of(whole)
    turned = given["truth_rotation"] @ np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    with pytest.warns(DataWarning, match=r"truth of vehicle_1: bearings to landmarks are 90 deg off \(median\)"):
        Recording.from_arrays(**(given | {"truth_rotation": turned}))


def test_pipes_are_refused_and_do_not_block(tmp_path: Path) -> None:
    for name in ("log.mcap", "topics.toml", "drive.bag"):
        os.mkfifo(tmp_path / name)
    folder = mrclam_files.write(tmp_path, seconds=2.0)
    (folder / "Barcodes.dat").unlink()
    os.mkfifo(folder / "Barcodes.dat")
    for work in (
        lambda: open_recording(tmp_path / "log.mcap"),
        lambda: load_map(tmp_path / "topics.toml"),
        lambda: open_recording("mrclam_6", tmp_path),
    ):
        with pytest.raises(CoopenvError, match=r"(log\.mcap|topics\.toml|Barcodes\.dat).*no regular file"):
            work()


def test_packed_networks_have_a_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "bomb.net.xml.gz"
    path.write_bytes(gzip.compress(b"<net>" + b" " * 3 * 2**20))
    monkeypatch.setattr(sumo_files, "MOST_BYTES", 2**20)
    with pytest.raises(CoopenvError, match=r"sumo\.net: .*bomb\.net\.xml\.gz.*: more than 1 MiB of XML"):
        sumo_files._read_network(sumo_files.Sumo(net=str(path)))
