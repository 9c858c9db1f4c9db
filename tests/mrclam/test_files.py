"""Files of the MR.CLAM format are read as they are, and what is wrong is named by file and line."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from coopenv.base.errors import DataError, DataWarning
from coopenv.mrclam.dataset import MAX_HOLD_S, HeldCommands, MotionCapture, find_folder
from coopenv.mrclam.recording import VARIANTS, check_variant, counted, load_dataset
from tests.helpers.mrclam_files import LANDMARKS, ORIGIN, command, pose, write


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write(tmp_path, seconds=4.0)


def change(path: Path, line: int, text: str) -> None:
    lines = path.read_text().splitlines(keepends=True)
    lines[line - 1] = text
    path.write_text("".join(lines))


def message(folder: Path) -> str:
    with pytest.raises(DataError) as caught:
        load_dataset("mrclam_6", folder)
    text = str(caught.value)
    assert "\n" not in text
    return text


def test_round_trip(folder):
    dataset = load_dataset("mrclam_6", folder)
    assert {subject: tuple(point) for subject, point in dataset.landmarks.items()} == LANDMARKS
    for robot in dataset.robots:
        np.testing.assert_allclose(robot.truth.t[0], -0.1, atol=1e-6)  # odometry is first at 0.1 s
        x, y, heading = pose(robot.subject, robot.truth.t + 0.1).T
        np.testing.assert_allclose(robot.truth.position, np.column_stack([x, y]), atol=1e-6)
        np.testing.assert_allclose(robot.truth.heading, np.unwrap(heading), atol=1e-6)
        np.testing.assert_allclose(robot.odometry[:, 1:], np.broadcast_to(command(robot.subject), (170, 2)), atol=1e-8)
        assert set(robot.detections[:, 1]) <= {*LANDMARKS, 1, 2, 3, 4, 5} - {robot.subject}
        assert robot.skipped == 0


def test_folder_its_parent_or_the_environment(folder, monkeypatch):
    assert find_folder("mrclam_6", folder) == folder
    assert find_folder("mrclam_6", str(folder.parent)) == folder
    monkeypatch.setenv("COOPENV_DATA", str(folder.parent))
    assert find_folder("mrclam_6") == folder
    renamed = folder.rename(folder.parent / "mine")
    assert find_folder("mrclam_6", renamed) == renamed


def test_folders_that_are_not_there(folder, monkeypatch):
    monkeypatch.delenv("COOPENV_DATA", raising=False)
    for name, data, words in (
        ("mrclam_6", None, "COOPENV_DATA"),
        ("mrclam_66", folder, "did you mean 'mrclam_6'"),
        ("mrclam_6", folder / "no", "does not exist"),
        ("mrclam_7", folder, "another sub-dataset"),
        ("mrclam_7", folder.parent, "MRCLAM_Dataset7"),
    ):
        with pytest.raises(DataError, match=words):
            find_folder(name, data)


def test_missing_file(folder):
    (folder / "Robot3_Odometry.dat").unlink()
    assert "Robot3_Odometry.dat: no such file" in message(folder)


@pytest.mark.parametrize(
    ("file", "line", "text", "words"),
    [
        ("Robot1_Odometry.dat", 9, f"{ORIGIN + 0.18} 0.1\n", "2 columns, expected 3"),
        ("Robot2_Groundtruth.dat", 7, f"{ORIGIN} 1 2 x\n", "'x' is not a number"),
        ("Robot4_Measurement.dat", 6, f"{ORIGIN + 1.04} 118 inf 0.1\n", "not finite"),
        ("Robot4_Measurement.dat", 6, f"{ORIGIN + 1.04} 118 -1 0.1\n", "negative range"),
        ("Robot4_Measurement.dat", 6, f"{ORIGIN + 1.04} 118.5 1 0.1\n", "whole"),
        ("Robot5_Odometry.dat", 8, f"{ORIGIN - 5} 0.1 0.1\n", "time runs backwards"),
        ("Robot5_Odometry.dat", 80, f"{ORIGIN + 0.5} 0.1 0.1\n", "rows may be out of order by less than 1 s"),
        ("Barcodes.dat", 6, "1 7\n", "occurs twice"),
        ("Barcodes.dat", 6, "21 7\n", "not in 1..20"),
        ("Landmark_Groundtruth.dat", 5, "5 0 0 0 0\n", "not in 6..20"),
    ],
)
def test_bad_line_is_named(folder, file, line, text, words):
    change(folder / file, line, text)
    said = message(folder)
    assert f"{file}:{line}: " in said
    assert words in said


def test_empty_files(folder):
    (folder / "Robot1_Measurement.dat").write_text("# nothing seen\n")
    with pytest.warns(DataWarning, match="no detections of robot 1"):
        assert len(load_dataset("mrclam_6", folder).robots[0].detections) == 0
    (folder / "Robot1_Odometry.dat").write_text("# nothing\n")
    assert "Robot1_Odometry.dat:1: 0 rows" in message(folder)


@pytest.mark.parametrize("file", ["Robot2_Odometry.dat", "Robot3_Groundtruth.dat"])
@pytest.mark.parametrize("late", [1e300, ORIGIN + 1e4])
def test_a_pause_of_hours_is_a_broken_time_stamp(folder, file, late):
    lines = (folder / file).read_text().splitlines()
    change(folder / file, len(lines), f"{late:.3f}" + lines[-1][lines[-1].index(" ") :] + "\n")
    assert message(folder).startswith(f"{folder / file}:{len(lines)}: ")
    assert "s after the row above, at most 3600" in message(folder)


def test_a_record_of_days_is_in_other_units(folder):
    path = folder / "Robot1_Odometry.dat"
    table = np.loadtxt(path)
    table[:, 0] = ORIGIN + 1e4 * (table[:, 0] - ORIGIN)
    np.savetxt(path, table, fmt="%.6f")
    line = 1 + int(np.argmax(table[:, 0] - table[0, 0] > 6 * 3600))
    assert f"{path}:{line}: " in message(folder) and "s after the first row, at most 21600" in message(folder)


def test_clocks_that_are_days_apart(folder):
    path = folder / "Robot4_Odometry.dat"
    table = np.loadtxt(path)
    table[:, 0] += 86400.0
    np.savetxt(path, table, fmt="%.6f")
    assert f"{path}:1: 86400 s apart from Robot1_Odometry.dat" in message(folder)


def test_rows_a_little_late_are_put_in_order(folder):
    """As in sub-dataset 9, where the second row of odometry stands .1 s before the first."""
    before = load_dataset("mrclam_6", folder).robots[1]
    path = folder / "Robot2_Odometry.dat"
    lines = path.read_text().splitlines(keepends=True)
    lines[4], lines[5], lines[60], lines[90] = lines[5], lines[4], lines[90], lines[60]
    path.write_text("".join(lines))
    with pytest.warns(DataWarning, match=r"put in order: 31 of Robot2_Odometry.dat$"):
        after = load_dataset("mrclam_6", folder).robots[1]
    np.testing.assert_array_equal(after.odometry, before.odometry)


def test_rows_with_unknown_values_are_left_out(folder):
    """The line that is named for another fault is still that of the file."""
    change(folder / "Robot3_Groundtruth.dat", 40, f"{ORIGIN + 0.70:.3f} NaN NaN NaN\n")
    with pytest.warns(DataWarning, match=r"rows with NaN left out: 1 of Robot3_Groundtruth.dat$"):
        robot = load_dataset("mrclam_6", folder).robots[2]
    assert np.isfinite(robot.truth.position).all() and len(robot.truth.t) == 199
    change(folder / "Robot3_Groundtruth.dat", 50, f"{ORIGIN + 0.90:.3f} 1 2 inf\n")
    assert "Robot3_Groundtruth.dat:50: a value is not finite" in message(folder)


# One clock, and the truth where motion capture is valid


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return load_dataset("mrclam_6", write(tmp_path_factory.mktemp("data")))


def test_clock_and_frames(dataset):
    assert dataset.duration_s == pytest.approx(39.38, abs=0.03)
    assert set(dataset.landmarks) == set(LANDMARKS)
    for robot in dataset.robots:
        assert robot.odometry[0, 0] == pytest.approx(0.0, abs=1e-6)
        times, seen = np.unique(robot.detections[:, 0], return_counts=True)
        assert (np.diff(robot.detections[:, 0]) >= 0).all() and seen.max() > 1
        assert times[0] >= 0.9


def test_truth_crosses_pi_the_short_way():
    truth = MotionCapture(np.array([0.0, 0.4]), np.zeros((2, 2)), np.unwrap([math.pi - 0.1, -math.pi + 0.1]))
    _, heading, valid, _ = truth.at(np.array([0.1, 0.2, 0.3]))
    np.testing.assert_allclose(heading, [math.pi - 0.05, -math.pi, -math.pi + 0.05], atol=1e-12)
    assert valid.all()


def test_truth_is_invalid_in_gaps_outside_and_where_corrupt():
    truth = MotionCapture(np.array([0.0, 0.2, 5.0, 5.2]), np.zeros((4, 2)), np.zeros(4), ((5.05, 5.15),))
    _, _, valid, heading = truth.at(np.array([-0.1, 0.0, 0.1, 0.2, 1.0, 5.0, 5.1, 5.2, 5.3]))
    assert valid.tolist() == [False, True, True, True, False, True, True, True, False]
    assert heading.tolist() == [False, True, True, True, False, True, False, True, False]


def test_ninth_recording_masks_robot_3(tmp_path):
    robots = load_dataset("mrclam_9", write(tmp_path, number=9, seconds=3.0)).robots
    assert [len(robot.truth.corrupt_heading) for robot in robots] == [0, 0, 1, 0, 0]
    start, end = robots[2].truth.corrupt_heading[0]
    assert end - start == pytest.approx(343)


def test_variants_hide(dataset):
    def subjects(variant, n):
        return set(dataset.robots[n].detections[counted(dataset.robots[n], variant), 1])

    for n in range(5):
        assert min(subjects("landmarks", n)) >= 6
        assert min(subjects("landmarks+robots", n)) < 6 <= max(subjects("landmarks+robots", n))
        assert n + 1 not in subjects("landmarks+robots", n)
    assert subjects("blind", 0) == subjects("landmarks+robots", 0)
    assert all(max(subjects("blind", n)) < 6 for n in (2, 3, 4))
    for variant in VARIANTS:
        assert check_variant(variant) == variant
    with pytest.raises(DataError, match="did you mean 'landmarks'"):
        check_variant("landmark")


def test_held_commands_are_integrated_exactly(dataset):
    odometry = np.array([[0.1, 0.2, 0.0], [0.6, 0.1, 1.5], [0.9, 0.3, -2.0], [1.4, 0.0, 0.0]])
    held = HeldCommands(replace(dataset.robots[0], odometry=odometry))
    t = np.array([0.0, 0.1, 0.35, 0.77, 1.2, 1.4, 3.0])
    fine = np.linspace(0.0, 3.0, 300_001)
    w, v = (np.diff(held.sums(fine), axis=0, append=np.nan) / 1e-5).T
    heading = np.concatenate([[0.0], np.cumsum(w[:-1]) * 1e-5])
    x = np.concatenate([[0.0], np.cumsum(v[:-1] * np.cos(heading[:-1])) * 1e-5])
    y = np.concatenate([[0.0], np.cumsum(v[:-1] * np.sin(heading[:-1])) * 1e-5])
    np.testing.assert_allclose(held.pose(t)[:, 2], np.interp(t, fine, heading), atol=1e-4)
    np.testing.assert_allclose(
        held.pose(t)[:, :2], np.stack([np.interp(t, fine, x), np.interp(t, fine, y)], -1), atol=1e-5
    )


def test_a_command_is_not_held_for_ever(dataset):
    held = HeldCommands(replace(dataset.robots[0], odometry=np.array([[0.0, 0.2, 0.5], [9.0, 0.1, 0.0]])))
    np.testing.assert_allclose(held.pose(np.array([1.0, 5.0, 20.0]))[:, 2], [0.5, 0.5 * MAX_HOLD_S, 0.5 * MAX_HOLD_S])
    turned, driven = held.sums(np.array([-1.0, 1.0, 5.0, 9.5, 20.0])).T
    np.testing.assert_allclose(turned, [0.0, 0.5, 1.0, 1.0, 1.0])
    np.testing.assert_allclose(driven, [0.0, 0.2, 0.4, 0.45, 0.6])


def test_detections_without_use_are_reported(tmp_path):
    folder = write(tmp_path, seconds=40.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_dataset("mrclam_6", folder)
    (folder / "Robot5_Measurement.dat").write_text("")
    path = folder / "Robot2_Measurement.dat"
    seen = sum(len(np.loadtxt(folder / f"Robot{robot}_Measurement.dat")) for robot in range(1, 5))
    own = len(np.loadtxt(path))
    table = np.loadtxt(path)
    table[1:, 1] = 999
    np.savetxt(path, table)
    with pytest.warns(DataWarning) as caught:
        robot = load_dataset("mrclam_6", folder).robots[1]
    assert (robot.skipped, len(robot.detections)) == (own - 1, 1)
    said = f"{own - 1} of {seen} detections left out: no robot or landmark of the map has their barcode"
    assert [str(w.message) for w in caught] == [f"mrclam_6: no detections of robot 5; {said}"]


def test_truth_in_degrees_or_mm_is_noticed(tmp_path):
    folder = write(tmp_path, seconds=6.0)
    path = folder / "Robot2_Groundtruth.dat"
    table = np.loadtxt(path)
    for factors in ((1.0, 1.0, 1.0, 57.29578), (1.0, 1000.0, 1000.0, 1.0)):
        np.savetxt(path, table * np.array(factors), fmt="%.6f")
        line = r"^mrclam_6: Robot2_Groundtruth\.dat: bearings to landmarks are \d+ deg off .* 4 in rad\?$"
        with pytest.warns(DataWarning, match=line):
            load_dataset("mrclam_6", folder)


def test_detections_beyond_the_odometry_are_left_out_and_reported(tmp_path):
    folder = write(tmp_path, seconds=6.0)
    path = folder / "Robot2_Measurement.dat"
    table, others = np.loadtxt(path), [len(robot.detections) for robot in load_dataset("mrclam_6", folder).robots]
    for late in (-3.0, 3600.0):
        np.savetxt(path, table + np.array([late, 0.0, 0.0, 0.0]), fmt="%.6f")
        with pytest.warns(DataWarning, match=r"left out: not within 0 to \d s, in which there is odometry"):
            robot = load_dataset("mrclam_6", folder).robots[1]
        assert robot.outside > 0 and robot.outside + len(robot.detections) == others[1]
        assert ((robot.detections[:, 0] >= 0.0) & (robot.detections[:, 0] <= 6.1)).all()


def test_bearings_in_degrees_are_refused(tmp_path):
    path = write(tmp_path, seconds=6.0) / "Robot2_Measurement.dat"
    table = np.loadtxt(path)
    table[:, 3] = np.degrees(table[:, 3])
    np.savetxt(path, table, fmt="%.6f")
    with pytest.raises(DataError, match=r"Robot2_Measurement.dat:\d+: bearing .*, expected radians, -pi to pi$"):
        load_dataset("mrclam_6", path.parent)


def test_a_file_may_have_a_byte_order_mark(tmp_path):
    path = write(tmp_path, seconds=6.0) / "Robot2_Odometry.dat"
    before = load_dataset("mrclam_6", path.parent).robots[1].odometry
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    np.testing.assert_array_equal(load_dataset("mrclam_6", path.parent).robots[1].odometry, before)
