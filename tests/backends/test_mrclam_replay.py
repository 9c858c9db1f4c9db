"""Recorded robots on one clock, as one stream, through the planar filters."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from typer.testing import CliRunner

from coopenv.backends.mrclam import CameraFrame, OdometrySample, events, load_dataset
from coopenv.backends.mrclam import __main__ as command_line
from coopenv.backends.mrclam.dataset import Truth, make_dataset
from coopenv.backends.mrclam.files import read_recording
from coopenv.backends.mrclam.judge import replay
from coopenv.backends.mrclam.planar import PLAIN, SELF_CALIBRATING, STATES, Message, PlanarFilter
from coopenv.errors import DataError
from tests.backends.mrclam_files import LANDMARKS, pose, real_folder, write

REAL = real_folder()


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return load_dataset("mrclam_6", write(tmp_path_factory.mktemp("data")))


@pytest.fixture(scope="module")
def recorded():
    start = time.perf_counter()
    result = load_dataset("mrclam_6", REAL)
    assert time.perf_counter() - start < 3
    return result


def test_clock_and_frames(dataset):
    assert dataset.duration_s == pytest.approx(39.38, abs=0.03)
    assert set(dataset.landmarks) == set(LANDMARKS)
    for robot in dataset.robots:
        assert robot.odometry[0, 0] == pytest.approx(0.0, abs=1e-6)
        times = [frame.t for frame in robot.frames]
        assert times == sorted(set(times))
        assert max(len(frame.subjects) for frame in robot.frames) > 1
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
    recording = replace(read_recording("mrclam_6", write(tmp_path, seconds=3.0)), name="mrclam_9")
    robots = make_dataset(recording).robots
    assert [len(robot.truth.corrupt_heading) for robot in robots] == [0, 0, 1, 0, 0]
    start, end = robots[2].truth.corrupt_heading[0]
    assert end - start == pytest.approx(343)


def test_events_are_ordered_and_complete(dataset):
    stream = list(events(dataset, "landmarks+robots"))
    assert all(a.t <= b.t for a, b in pairwise(stream))
    samples = [event for event in stream if isinstance(event, OdometrySample)]
    frames = [event for event in stream if isinstance(event, CameraFrame)]
    assert len(samples) == sum(len(robot.odometry) for robot in dataset.robots)
    assert len(frames) == sum(len(robot.frames) for robot in dataset.robots)
    for frame in frames:
        np.testing.assert_allclose(np.linalg.norm(frame.bearings, axis=1), 1, atol=1e-12)
        assert (frame.bearings[:, 2] == 0).all()
        assert len(frame.targets) == len(frame.ranges)
    x, y, heading = pose(1, np.array([frames[0].t + 0.1]))[0]  # the first frame is robot 1's, the origin at 0.1 s
    point = LANDMARKS[frames[0].targets[0] + 1]
    body = np.array([[math.cos(heading), math.sin(heading)], [-math.sin(heading), math.cos(heading)]]) @ (
        point - np.array([x, y])
    )
    np.testing.assert_allclose(frames[0].bearings[0, :2], body / np.linalg.norm(body), atol=1e-4)


def test_variants_hide(dataset):
    def targets(variant, robot):
        return {
            t for e in events(dataset, variant) if isinstance(e, CameraFrame) and e.robot == robot for t in e.targets
        }

    for robot in range(5):
        assert min(targets("landmarks", robot)) >= 5
        assert min(targets("landmarks+robots", robot)) < 5 <= max(targets("landmarks+robots", robot))
    assert targets("blind", 0) == targets("landmarks+robots", 0)
    assert all(max(targets("blind", robot)) < 5 for robot in (2, 3, 4))
    with pytest.raises(DataError, match="did you mean 'landmarks'"):
        next(events(dataset, "landmark"))


@pytest.mark.parametrize("variant", ["landmarks", "landmarks+robots", "blind"])
def test_filters_are_right_without_noise(dataset, variant):
    for score in replay(dataset, variant, PLAIN)[1]:
        assert score.position_rmse_m < 2e-3
        assert score.heading_rmse_deg < 0.1
        assert score.rejected == 0
        assert score.anees < 1
    for score in replay(dataset, variant, SELF_CALIBRATING)[1]:
        assert score.position_rmse_m < 0.15  # starts with a lead and scales that these robots do not have
        assert score.anees < 2


def test_dead_reckoning_is_exact_without_noise(dataset):
    assert max(score.position_rmse_m for score in replay(dataset, None, PLAIN)[1]) < 1e-3


def numeric(function, x, step=1e-6):
    return np.stack([(function(x + step * e) - function(x - step * e)) / (2 * step) for e in np.eye(len(x))], axis=-1)


def test_motion_derivatives_agree_with_differences():
    tuning = replace(SELF_CALIBRATING, walk=(0.0,) * 6, turn_noise=(0, 0, 0), path_noise=(0, 0), slide_noise=0)
    x = np.array([0.3, -0.2, 0.7, 0.93, 0.97, -0.04, 0.205, 0.01, 0.6])

    def filtered(state, covariance):
        own = PlanarFilter(tuning, 0.0, (0, 0, 0))
        for k in range(9):
            own._odometer.add(0.03 * k, 0.05 + 0.01 * k, 0.4 - 0.1 * k)
        own.t, own.state, own.covariance = 0.22, state.copy(), covariance
        own.advance(0.3)
        return own

    f = numeric(lambda s: filtered(s, np.eye(STATES)).state, x)
    root = np.diag(np.arange(1.0, STATES + 1))
    np.testing.assert_allclose(filtered(x, root).covariance, f @ root @ f.T, atol=2e-4)


def test_sightings_correct_both():
    tuning = replace(PLAIN, start_std=(0.3, 0.3, 0.05))
    for mutual in (False, True):
        own = PlanarFilter(tuning, 0.0, (0.1, -0.2, 0.0))  # it is at the origin and heads along x
        there = np.array([2.0, 1.0, 2.5])
        message = Message(there, np.diag([1e-6, 1e-6, 1e-6]))
        if mutual:
            own.seen(math.atan2(-1, -2) - 2.5, message)
        else:
            own.robot(math.atan2(1, 2), message)
        line = np.array([-1, 2]) / math.sqrt(5)
        assert abs(own.state[:2] @ line) < 0.5 * abs(np.array([0.1, -0.2]) @ line)
        assert own.accepted == 1


def test_intersection_never_claims_more_than_either_alone():
    own = PlanarFilter(replace(SELF_CALIBRATING, dependent=1.0), 0.0, (0.0, 0.0, 0.0))
    own.covariance[:3, :3] = np.diag([0.04, 0.04, 1e-4])
    before = own.covariance.copy()
    for _ in range(200):
        own.robot(math.atan2(1, 2), Message(np.array([2.0, 1.0, 0.0]), before[:3, :3]))
    line = np.array([-1, 2]) / math.sqrt(5)
    assert line @ own.covariance[:2, :2] @ line > 0.5 * 0.04


def test_command(tmp_path):
    folder = write(tmp_path, seconds=6.0)
    runner = CliRunner()
    app = command_line.typer.Typer()
    app.command()(command_line.main)
    result = runner.invoke(app, ["mrclam_6", "--data", str(folder)])
    assert result.exit_code == 0
    assert "landmarks+robots" in result.output
    (folder / "Barcodes.dat").unlink()
    result = runner.invoke(app, ["mrclam_6", "--data", str(folder)])
    assert result.exit_code == 2
    assert "Barcodes.dat: no such file" in result.output


@pytest.mark.skipif(REAL is None, reason="no MRCLAM_Dataset6 (name its parent in COOPENV_DATA)")
class TestRecorded:
    def test_content(self, recorded):
        assert recorded.duration_s == pytest.approx(887.947, abs=1e-3)
        assert sorted(recorded.landmarks) == list(range(6, 21))
        assert [robot.skipped for robot in recorded.robots] == [1, 0, 2, 3, 0]
        detections = [sum(len(f.subjects) for f in robot.frames) for robot in recorded.robots]
        assert detections == [1941, 4031, 5625, 2396, 5378]

    def test_plain_filter_gives_the_known_figures(self, recorded):
        for variant, known in ((None, 2.667), ("landmarks", 0.197)):
            scores = replay(recorded, variant, PLAIN)[1]
            assert mean(scores) == pytest.approx(known, rel=0.05)

    def test_self_calibrating_filter_reaches_its_targets(self, recorded):
        scores = {v: replay(recorded, v, SELF_CALIBRATING)[1] for v in ("landmarks", "landmarks+robots", "blind")}
        assert mean(scores["landmarks"]) < 0.18
        assert mean(scores["landmarks+robots"]) < mean(scores["landmarks"])
        assert mean(scores["blind"]) < 0.40
        for rows in scores.values():
            assert 0.3 < np.mean([score.anees for score in rows]) < 1.5


def mean(scores) -> float:
    return float(np.mean([score.position_rmse_m for score in scores]))
