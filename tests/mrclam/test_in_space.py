"""A recorded sub-dataset as vehicles in space, with ranges, a level floor and calibrated odometry."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from coopenv.measurements.kinds import Placed
from coopenv.mrclam.in_space import FLOOR_PERIOD_TICKS, LEAD_S, spatial_recording_of
from coopenv.mrclam.recording import TICK_S, load_dataset
from coopenv.observers.runner import run
from tests.helpers.mrclam_files import BARCODES, LANDMARKS, ORIGIN, barrier_robots, command, pose, write

ORIGIN_S = 0.1  # of the synthetic files: the first odometry sample


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return load_dataset("mrclam_6", write(tmp_path_factory.mktemp("data"), seconds=20.0, calibrated=True))


@pytest.fixture(scope="module")
def recording(dataset):
    return spatial_recording_of(dataset, "landmarks+robots")


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


@pytest.mark.parametrize("observer", ["riccati", "robust", "centralised", "dead_reckoning"])
def test_the_zoo_runs_and_stays_on_the_plane(dataset, observer):
    recording = spatial_recording_of(dataset, "landmarks+robots")
    result = run(observer, recording)
    assert not result.failure and recording.on_a_plane and result.nees_dof == 3
    assert (result.position_rmse() < 0.1).all()
    assert np.abs(result.position[..., 2]).max() < 1e-3
    assert np.abs(result.rotation[..., 2, :2]).max() < 1e-3


def test_ranges_are_distances_at_the_times_of_the_files(tmp_path):
    """Every row of a robot's file is a depth towards the target of the barcode, and a range at the next tick."""
    folder = write(tmp_path, seconds=20.0, calibrated=True)
    recording = spatial_recording_of(load_dataset("mrclam_6", tmp_path), "landmarks+robots")
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
    ranges = spatial_recording_of(dataset, "blind").readings["range"]
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
    sensor = spatial_recording_of(barrier_robots(1, 2.0), "landmarks").setups[0].sensors[0]
    own = Placed.at(np.zeros((2, 3)))
    rows = sensor.linearised(np.eye(3), own, Placed.at(np.array([[1.0, 0, 0], [0, 4.0, 0]])), np.array([[1.1], [3.9]]))
    np.testing.assert_allclose(rows.noise[:, 0], [0.03**2 + 0.03**2, 0.03**2 + 0.12**2])


def test_a_command_becomes_motion_later(dataset):
    """A robot that is sent off at 5 s sets out after the lead of its commands; 0.4 s later it moves as nominal."""
    robots = list(dataset.robots)
    odometry = robots[0].odometry.copy()
    odometry[odometry[:, 0] < 5.0, 1:] = 0.0
    robots[0] = replace(robots[0], odometry=odometry)
    r = spatial_recording_of(replace(dataset, robots=tuple(robots)), "landmarks")
    v, omega = command(1)
    assert not r.translation[r.t < 4.99 + LEAD_S, 0].any() and not r.angular_velocity[r.t < 4.99 + LEAD_S, 0].any()
    np.testing.assert_allclose(r.velocity[r.t > 5.51 + LEAD_S, 0, 0], v, rtol=1e-6)
    np.testing.assert_allclose(r.angular_velocity[r.t > 5.51 + LEAD_S, 0, 2], omega, rtol=1e-6)
    turned = Rotation.from_matrix(r.rotation[200, 0]).as_rotvec()
    np.testing.assert_allclose(turned, [0, 0, omega * TICK_S], atol=1e-9)


def test_roll_and_pitch_are_known_without_detections(tmp_path):
    """After 38 s the heading's variance has grown far beyond those of roll and pitch."""
    dataset = load_dataset("mrclam_6", write(tmp_path, calibrated=True))
    alone = tuple(replace(robot, detections=robot.detections[:0]) for robot in dataset.robots)
    recording = spatial_recording_of(replace(dataset, robots=alone), "blind")
    std = np.sqrt(np.diagonal(run("self_calibrating", recording).covariance[-1, 3], axis1=0, axis2=1))
    assert std[:2].max() < 0.06 and std[2] > 0.15 and std[5] < 0.05
