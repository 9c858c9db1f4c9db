"""Recorded robots on one clock, with the truth where motion capture is valid."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace

import numpy as np
import pytest

from coopenv.backends.mrclam import VARIANTS, load_dataset
from coopenv.backends.mrclam.dataset import MAX_HOLD_S, HeldCommands, Truth
from coopenv.backends.mrclam.recording import check_variant, counted
from coopenv.base.errors import DataError, DataWarning
from tests.helpers.mrclam_files import LANDMARKS, write


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
    truth = Truth(np.array([0.0, 0.4]), np.zeros((2, 2)), np.unwrap([math.pi - 0.1, -math.pi + 0.1]))
    _, heading, valid, _ = truth.at(np.array([0.1, 0.2, 0.3]))
    np.testing.assert_allclose(heading, [math.pi - 0.05, -math.pi, -math.pi + 0.05], atol=1e-12)
    assert valid.all()


def test_truth_is_invalid_in_gaps_outside_and_where_corrupt():
    truth = Truth(np.array([0.0, 0.2, 5.0, 5.2]), np.zeros((4, 2)), np.zeros(4), ((5.05, 5.15),))
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
    v, w = held.commands(fine)
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
    v, _ = held.commands(np.array([-1.0, 1.0, 5.0, 9.5, 20.0]))
    assert v.tolist() == [0.0, 0.2, 0.0, 0.1, 0.0]


def test_what_is_of_no_use_is_told(tmp_path):
    folder = write(tmp_path, seconds=6.0)
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
    said = f"{own - 1} of {seen} detections left out: no robot carries their barcode"
    assert [str(w.message) for w in caught] == [f"mrclam_6: no detections of robot 5; {said}"]
