"""A recorded sub-dataset on ticks, as every observer gets it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from coopenv.base.errors import DataError
from coopenv.measurements.kinds import Placed
from coopenv.mrclam.dataset import MotionCapture
from coopenv.mrclam.recording import (
    DRIFT_STD,
    FLOOR_PERIOD_TICKS,
    LEAD_S,
    MESSAGE_PERIOD_TICKS,
    START_STD,
    TICK_S,
    load_dataset,
    recording_of,
)
from coopenv.observers.runner import run
from coopenv.sources.sources import open_recording
from tests.helpers.env_suite import rest_slow
from tests.helpers.mrclam_files import BARCODES, LANDMARKS, ORIGIN, barrier_robots, motion, pose, write

ORIGIN_S = 0.1  # of the synthetic files: the first odometry sample


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return load_dataset("mrclam_6", write(tmp_path_factory.mktemp("data"), seconds=20.0))


@pytest.fixture(scope="module")
def recording(dataset):
    return recording_of(dataset, "landmarks+robots")


def test_names_and_shapes(recording):
    L = len(LANDMARKS)
    setup = recording.setups[2]
    assert [s.name for s in recording.setups] == [f"vehicle_{n}" for n in range(1, 6)]
    assert setup.target_names == (*(f"landmark_{s}" for s in LANDMARKS), *(f"vehicle_{n}" for n in range(1, 6)))
    assert setup.landmarks == L and setup.targets.tolist() == [0, 1, 2, 3, 4, 5, 6, 8, 9]
    assert recording.bearings.shape == (recording.ticks, 5, L + 5, 3)
    np.testing.assert_allclose(recording.landmarks[7, :, :2], list(LANDMARKS.values()))
    assert recording.ticks * TICK_S == pytest.approx(19.4, abs=0.1)


def test_increments_lead_from_one_true_pose_to_the_next(recording):
    first = 16  # the first commands have taken effect
    R, p = recording.truth.rotation[first].copy(), recording.truth.position[first].copy()
    for k in range(first + 1, recording.ticks):
        p = p + (R @ recording.translation[k][..., None])[..., 0]
        R = R @ recording.rotation[k]
    np.testing.assert_allclose(p, recording.truth.position[-1], atol=1e-3)
    np.testing.assert_allclose(R, recording.truth.rotation[-1], atol=1e-3)


def test_truth_is_planar(recording):
    x, y, heading = pose(2, ORIGIN_S + recording.t).T
    np.testing.assert_allclose(recording.truth.position[:, 1], np.stack([x, y, 0 * x], -1), atol=1e-4)
    np.testing.assert_allclose(
        recording.truth.rotation[:, 1], Rotation.from_euler("z", heading[:, None]).as_matrix(), atol=1e-3
    )


def test_bearings_are_turned_to_the_tick(recording):
    """View of the camera at the tick, but for the short distance driven since the frame."""
    seen = recording.visible[:, :, : recording.setups[0].landmarks]
    assert seen.any(axis=(0, 2)).all()
    worst = 0.0
    for k, i, n in np.argwhere(seen):
        x, y, heading = pose(i + 1, np.array([ORIGIN_S + recording.t[k]]))[0]
        dx, dy = list(LANDMARKS.values())[n] - np.array([x, y])
        expected = math.atan2(dy, dx) - heading
        error = (math.atan2(*recording.bearings[k, i, n, 1::-1]) - expected + math.pi) % (2 * math.pi) - math.pi
        worst = max(worst, abs(error) * math.hypot(dx, dy))
    assert worst < TICK_S * 0.16  # m; without the turn it were 0.005 rad times 4 m more
    assert np.isnan(recording.bearings[~recording.visible]).all()


def test_messages_arrive_one_tick_late(recording):
    inbox = recording.inbox_tick
    assert (inbox[0] == -1).all()
    for k in (1, 2, 3, 10):
        expected = (k - 1) - (k - 1) % MESSAGE_PERIOD_TICKS
        assert (inbox[k][~np.eye(5, dtype=bool)] == expected).all()
        assert (np.diag(inbox[k]) == -1).all()


def with_truth(dataset, n, t, corrupt=()):
    t = np.asarray(t, float)
    x, y, heading = pose(n + 1, ORIGIN_S + t).T
    robots = list(dataset.robots)
    robots[n] = replace(robots[n], truth=MotionCapture(t, np.stack([x, y], -1), np.unwrap(heading), corrupt))
    return replace(dataset, robots=tuple(robots))


def test_truth_has_gaps(dataset):
    sparse = [*np.arange(0, 5, 0.02), *np.arange(7, 9, 0.02), 12.013, 15.0]
    r = recording_of(with_truth(dataset, 1, sparse, ((8.0, 8.5),)), "landmarks")
    known = np.isfinite(r.truth.position[:, 1, 0])
    expected = (r.t < 4.99) | ((r.t > 6.99) & (r.t < 8.99))
    expected[[240, 300]] = True  # rows that stand alone, at the tick next to them
    assert known.tolist() == expected.tolist()
    x, y, _ = pose(2, np.array([ORIGIN_S + r.t[240]]))[0]
    np.testing.assert_allclose(r.truth.position[240, 1, :2], [x, y], atol=5e-4)  # 2 mm from the row
    heading_known = np.isfinite(r.truth.rotation[:, 1, 0, 0])
    assert not heading_known[(r.t > 8.0) & (r.t < 8.5)].any()
    assert heading_known[known & ((r.t < 7.9) | (r.t > 8.55))].all()


def test_a_robot_seen_late_starts_at_its_dead_reckoning(dataset):
    r = recording_of(with_truth(dataset, 3, np.arange(6.0, 18.0, 0.02)), "landmarks")
    whole = recording_of(dataset, "landmarks")
    lead = 0.55 * 0.15  # m, by which this robot sets out earlier than commands have all of their effect
    np.testing.assert_allclose(r.start_position, whole.start_position, atol=lead)
    np.testing.assert_allclose(r.start_rotation, whole.start_rotation, atol=lead)
    std = np.sqrt(np.diagonal(r.start_covariance, axis1=1, axis2=2))
    np.testing.assert_allclose(std[0], np.repeat(START_STD, 3))
    np.testing.assert_allclose(std[3], np.repeat(np.hypot(START_STD, np.array(DRIFT_STD) * math.sqrt(6.0)), 3))


def test_a_robot_never_seen_is_an_error(dataset):
    with pytest.raises(DataError, match="robot 4: no ground truth"):
        recording_of(with_truth(dataset, 3, [-5.0, -4.9]), "landmarks")


@pytest.mark.parametrize("variant", rest_slow(["landmarks", "landmarks+robots", "blind"], 1, 2))
@pytest.mark.parametrize("observer", ["mekf_covariance", "self_calibrating"])
def test_observers_follow_robots_without_noise(dataset, observer, variant):
    """Robots that move as the nominal calibration says, but set out at once, and not up to 0.55 s later."""
    result = run(observer, recording_of(dataset, variant))
    assert not result.failure
    assert (result.position_rmse() < 0.1).all()
    assert (result.anees(after=TICK_S) < 2).all()


@pytest.mark.parametrize("observer", ["riccati", "robust", "centralised", "dead_reckoning"])
def test_the_zoo_runs_and_stays_on_the_plane(dataset, observer):
    recording = recording_of(dataset, "landmarks+robots")
    result = run(observer, recording)
    assert not result.failure and recording.on_a_plane and result.nees_dof == 3
    assert (result.position_rmse() < 0.1).all()
    assert np.abs(result.position[..., 2]).max() < 1e-3
    assert np.abs(result.rotation[..., 2, :2]).max() < 1e-3


def test_both_names_open_it(recording, tmp_path):
    write(tmp_path, seconds=20.0)
    for name in ("mrclam_6", "mrclam_6_space"):
        opened = open_recording(name, tmp_path)
        np.testing.assert_array_equal(opened.translation, recording.translation)
        np.testing.assert_array_equal(opened.readings["range"], recording.readings["range"])
    with pytest.raises(DataError, match="unknown data set 'mrclam_0'"):
        open_recording("mrclam_0_space", tmp_path)


def test_ranges_are_distances_at_the_times_of_the_files(tmp_path):
    """Every row of a robot's file is a depth towards the target of the barcode, and a range at the next tick."""
    folder = write(tmp_path, seconds=20.0)
    recording = recording_of(load_dataset("mrclam_6", tmp_path), "landmarks+robots")
    subjects = {barcode: subject for subject, barcode in BARCODES.items()}
    rows = np.loadtxt(folder / "Robot3_Measurement.dat")
    expected = {}
    for time, barcode, _, _ in rows:
        stamp = np.array([time - ORIGIN])
        subject = subjects[int(barcode)]
        there = pose(subject, stamp)[0, :2] if subject <= 5 else LANDMARKS[subject]
        k = math.ceil((time - ORIGIN - ORIGIN_S) / TICK_S - 1e-4)
        expected[k, recording.setups[2].target_names.index(named(subject))] = math.dist(there, pose(3, stamp)[0, :2])
    ranges = recording.readings["range"][:, 2, :, 0]
    assert len(expected) > 50 and len(expected) == np.isfinite(ranges).sum()
    for (k, target), distance in expected.items():
        assert ranges[k, target] == pytest.approx(distance, abs=1e-6)
    assert np.array_equal(np.isfinite(ranges), recording.visible[:, 2])


def named(subject):
    return f"vehicle_{subject}" if subject <= 5 else f"landmark_{subject}"


def test_a_blind_robot_has_no_ranges_to_landmarks(dataset):
    ranges = recording_of(dataset, "blind").readings["range"]
    assert not np.isfinite(ranges[:, 2:, : len(LANDMARKS)]).any()
    assert np.isfinite(ranges[:, :2, : len(LANDMARKS)]).any() and np.isfinite(ranges[:, 2:, len(LANDMARKS) :]).any()


def test_the_floor_is_measured_every_two_seconds(recording):
    for sensor in recording.setups[0].sensors[1:]:
        measured = np.isfinite(recording.readings[sensor.name][:, 3, 0, 0])
        assert np.flatnonzero(measured).tolist() == [*range(1, recording.ticks, FLOOR_PERIOD_TICKS)]
        assert not recording.readings[sensor.name][measured].any()
    level, height = (sensor.std for sensor in recording.setups[0].sensors[1:])
    assert level[:2].max() < 0.1 < 100.0 < level[2] and height[2] < 0.1 < 100.0 < height[:2].min()


def test_a_range_is_less_certain_the_farther_the_target():
    sensor = recording_of(barrier_robots(1, 2.0), "landmarks").setups[0].sensors[0]
    own = Placed.at(np.zeros((2, 3)))
    rows = sensor.linearised(np.eye(3), own, Placed.at(np.array([[1.0, 0, 0], [0, 4.0, 0]])), np.array([[1.1], [3.9]]))
    np.testing.assert_allclose(rows.noise[:, 0], [0.03**2 + 0.03**2, 0.03**2 + 0.12**2])


def test_a_command_becomes_motion_later(dataset):
    """A robot that is sent off at 5 s sets out after the lead of its commands; 0.4 s later it moves as nominal."""
    robots = list(dataset.robots)
    odometry = robots[0].odometry.copy()
    odometry[odometry[:, 0] < 5.0, 1:] = 0.0
    robots[0] = replace(robots[0], odometry=odometry)
    r = recording_of(replace(dataset, robots=tuple(robots)), "landmarks")
    v, omega = motion(1)
    assert not r.translation[r.t < 4.99 + LEAD_S, 0].any() and not r.angular_velocity[r.t < 4.99 + LEAD_S, 0].any()
    np.testing.assert_allclose(r.velocity[r.t > 5.51 + LEAD_S, 0, 0], v, rtol=1e-6)
    np.testing.assert_allclose(r.angular_velocity[r.t > 5.51 + LEAD_S, 0, 2], omega, rtol=1e-6)
    turned = Rotation.from_matrix(r.rotation[200, 0]).as_rotvec()
    np.testing.assert_allclose(turned, [0, 0, omega * TICK_S], atol=1e-9)


def test_roll_and_pitch_are_known_without_detections(tmp_path):
    """After 38 s the heading's variance has grown far beyond those of roll and pitch."""
    dataset = load_dataset("mrclam_6", write(tmp_path))
    alone = tuple(replace(robot, detections=robot.detections[:0]) for robot in dataset.robots)
    recording = recording_of(replace(dataset, robots=alone), "blind")
    std = np.sqrt(np.diagonal(run("self_calibrating", recording).covariance[-1, 3], axis1=0, axis2=1))
    assert std[:2].max() < 0.06 and std[2] > 0.15 and std[5] < 0.05
