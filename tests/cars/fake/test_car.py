"""Fake cars against the simulator: where they start, how they move, and what their sensors read."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from coopenv.backends.base import Command
from coopenv.backends.simulated import Simulated
from coopenv.cars.codec import stamp_of
from coopenv.cars.deployment import Sensors
from coopenv.cars.profile import Role
from coopenv.scenario import load_scenario
from tests.helpers.fakes import CROSSING, EXACT, OVERTAKING, Stage

SEQUENCE = [(0.4, 0.3, 1.0), (0.25, -0.4, 1.5), (0.05, 0.2, 0.5), (0.5, 0.0, 1.0), (0.0, 0.5, 1.0)]
"""Speed m/s, steering rad, duration s; the third is within the dead band."""


def pose(stage: Stage, car: str) -> tuple[np.ndarray, np.ndarray]:
    world = stage.cars[car].world
    return world.pose(world.agent)


@pytest.mark.parametrize("seed", [0, 5, 2**40 + 1])
def test_it_starts_where_the_simulator_does(seed: int) -> None:
    stage = Stage("svea_overtaking", OVERTAKING, seed=3)
    stage.drive("svea8", 0.2, 0.1, 1.0)
    stage.reset(seed)
    stage.run(0.02)
    truth = Simulated(stage.scenario).reset(seed, {}).truth
    assert truth is not None
    for i, car in enumerate(stage.cars):
        R, p = pose(stage, car)
        assert_allclose(p, truth.position[i], atol=1e-12)
        assert_allclose(R, truth.rotation[i], atol=1e-12)
    stage.run(1.0)
    assert_allclose(pose(stage, "svea8")[1], truth.position[1], atol=1e-12)  # what was commanded before is forgotten


def test_it_moves_as_the_simulator_does() -> None:
    """Five seconds of starts, turns and a stop, within a centimetre."""
    stage = Stage("svea_overtaking", OVERTAKING, EXACT)
    stage.reset(7)
    stage.run(0.001)
    simulated = Simulated(load_scenario("svea_overtaking", {**EXACT, "termination.collision": False}))
    simulated.reset(7, {})
    places, headings, expected = [], [], []
    for speed, steering, duration in SEQUENCE:
        for _ in range(round(20 * duration)):
            for _ in simulated.advance(Command(np.full(2, speed), np.full(2, steering), np.full(2, 1.0))):
                pass
            stage.command("svea7", speed, steering)
            stage.run(0.05)
            R, p = pose(stage, "svea7")
            places.append(p.copy())
            headings.append(np.arctan2(R[1, 0], R[0, 0]))
            state = simulated._world.view("position")[0, 4], simulated._world.view("rotation")[0, 4]
            expected.append([*state[0], np.arctan2(state[1][1, 0], state[1][0, 0])])
    found = np.column_stack([places, headings])
    assert_allclose(found[:, :3], np.array(expected)[:, :3], atol=0.01)
    assert_allclose(found[:, 3], np.array(expected)[:, 3], atol=0.02)
    assert np.linalg.norm(found[-1, :2] - found[0, :2]) > 0.8


def test_without_commands_it_stands_after_half_a_second() -> None:
    stage = Stage("svea_overtaking", OVERTAKING, EXACT)
    stage.drive("svea7", 0.4, 0.0, 1.0)
    stage.forget()
    stage.run(1.5)
    speeds = np.array([m.twist.twist.linear.x for m in stage.arrivals("svea7", Role.TRUTH)])
    times = 0.01 * np.arange(len(speeds))
    assert (speeds[times < 0.45] > 0.35).all()
    assert (np.abs(speeds[times > 1.2]) < 3e-3).all()


@pytest.mark.parametrize("odometry", ["wheel", "wheel+imu"])
def test_without_noise_sensors_are_exact(odometry: Any) -> None:
    stage = Stage("svea_overtaking", OVERTAKING, EXACT, Sensors(odometry=odometry))
    stage.drive("svea7", 0.3, 0.25, 3.0)
    truth = stage.arrivals("svea7", Role.TRUTH)[-1].twist.twist
    wheel, imu = (stage.arrivals("svea7", role)[-1] for role in (Role.WHEEL, Role.IMU))
    assert wheel.twist.twist.linear.x == pytest.approx(truth.linear.x, abs=1e-6) == pytest.approx(0.3, abs=1e-3)
    turn = 0.3 * np.tan(0.25) / 0.324
    for read in (imu.angular_velocity.z, truth.angular.z):
        assert read == pytest.approx(turn, abs=1e-3)
    said = wheel.twist.twist.angular.z  # which nobody is to take for the turn rate where there is a gyro
    assert said == (pytest.approx(turn, abs=1e-3) if odometry == "wheel" else 0.0)
    assert imu.orientation_covariance[0] == -1.0


def test_the_cars_own_filter_is_where_it_went() -> None:
    stage = Stage("svea_overtaking", OVERTAKING, EXACT)
    stage.run(0.05)
    R0, p0 = (value.copy() for value in pose(stage, "svea7"))
    stage.drive("svea7", 0.3, 0.3, 4.0)
    R, p = pose(stage, "svea7")
    said = stage.arrivals("svea7", Role.ODOMETRY)[-1]
    q = said.pose.pose.orientation
    assert_allclose([said.pose.pose.position.x, said.pose.pose.position.y], (R0.T @ (p - p0))[:2], atol=0.03)
    turned = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    assert np.degrees(Rotation.from_matrix(turned.T @ R0.T @ R).magnitude()) < 3.0
    assert said.header.frame_id == "svea7/odom"


def test_errors_that_last_are_the_simulators() -> None:
    stage = Stage("svea_overtaking", OVERTAKING, seed=11)
    simulated = Simulated(stage.scenario)
    simulated.reset(11, {})
    stage.drive("svea8", 0.2, 0.0, 10.0)
    scale = simulated._world.view("odometry_scale")[0, 1]
    bias = simulated._world.view("gyro_bias")[0, 1]
    wheel = np.array([m.twist.twist.linear.x for m in stage.arrivals("svea8", Role.WHEEL)[50:]])
    gyro = np.array([m.angular_velocity.z for m in stage.arrivals("svea8", Role.IMU)])
    assert wheel.mean() == pytest.approx(0.2 * (1 + scale), abs=4 * wheel.std() / np.sqrt(len(wheel)))
    assert wheel.std() == pytest.approx(0.02 * np.sqrt(50 / 100), rel=0.15)
    assert gyro.mean() == pytest.approx(bias[2], abs=4 * gyro.std() / np.sqrt(len(gyro)))
    assert gyro.std() == pytest.approx(0.02, rel=0.1)
    assert abs(scale) > 1e-3


def test_sensors_are_asynchronous() -> None:
    stage = Stage("svea_overtaking", OVERTAKING)
    stage.run(5.0)
    rates = {Role.DETECTIONS: 60, Role.BEARINGS: 60, Role.WHEEL: 50, Role.IMU: 100, Role.ODOMETRY: 20, Role.TRUTH: 100}
    for role, rate in {**rates, Role.STATE: 5, Role.BATTERY: 5, Role.CAMERA_INFO: 1, Role.REMOTE: 5}.items():
        stamps = np.array([stamp_of(m) for m in stage.arrivals("svea7", role)]) * 1e-9
        assert len(stamps) == pytest.approx(5 * rate, abs=1.01), role
        gaps = np.diff(stamps) * rate
        assert (np.abs(gaps - 1.0) < 0.11).all(), role
        assert rate < 20 or gaps.std() > 0.01, role
    assert stage.arrivals("svea7", Role.STATE)[0].armed
    assert not {stamp_of(m) for m in stage.arrivals("svea7", Role.WHEEL)} & {
        stamp_of(m) for m in stage.arrivals("svea7", Role.IMU)
    }


def test_a_moving_landmark_drives_its_motion_and_says_where_it_is() -> None:
    stage = Stage("svea_crossing", CROSSING, EXACT)
    stage.reset(0)
    stage.run(6.0)
    R, p = pose(stage, "svea3")
    assert_allclose(p, [-1.6 + 0.26 * 4.0, 1.45, 0.0], atol=0.005)
    assert_allclose(R, np.eye(3), atol=1e-9)
    said = stage.arrivals("svea3", Role.ESTIMATE)
    place = said[-1].pose.pose.position
    assert_allclose([place.x, place.y, place.z], p, atol=0.005)
    assert said[-1].header.frame_id == "map"
    assert len(said) == pytest.approx(360, abs=3)
    assert not stage.arrivals("svea3", Role.DETECTIONS) and not stage.arrivals("svea3", Role.WHEEL)
    assert len(stage.arrivals("svea3", Role.TRUTH)) == pytest.approx(600, abs=3)
