"""Fake cars against the simulator, and their cameras against an independent projection."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from coopenv.cars.messages.codec import stamp_of
from coopenv.cars.settings.deployment import Sensors
from coopenv.cars.settings.profile import Role
from coopenv.scenario import load_scenario
from coopenv.sources.base import Command
from coopenv.sources.worlds import Simulated
from tests.helpers.fakes import CAMERA, CROSSING, EXACT, MARKER, MARKERS, OVERTAKING, Stage, turned

SEQUENCE = [(0.4, 0.3, 1.0), (0.25, -0.4, 1.5), (0.05, 0.2, 0.5), (0.5, 0.0, 1.0), (0.0, 0.5, 1.0)]
"""Speed m/s, steering rad, duration s; the third is within the dead band."""


@pytest.mark.parametrize("seed", [5, 2**40 + 1])
def test_it_starts_where_the_simulator_does(seed: int) -> None:
    stage = Stage("svea_overtaking", OVERTAKING, seed=3)
    stage.drive("svea8", 0.2, 0.1, 1.0)
    stage.reset(seed)
    stage.run(0.02)
    truth = Simulated(stage.scenario).reset(seed, {}).truth
    assert truth is not None
    for i, car in enumerate(stage.cars):
        R, p = stage.pose(car)
        assert_allclose(p, truth.position[i], atol=1e-12)
        assert_allclose(R, truth.rotation[i], atol=1e-12)
    stage.run(1.0)
    assert_allclose(stage.pose("svea8")[1], truth.position[1], atol=1e-12)  # what was commanded before is forgotten


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
            R, p = stage.pose("svea7")
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
    for rate in (imu.angular_velocity.z, truth.angular.z):
        assert rate == pytest.approx(turn, abs=1e-3)
    said = wheel.twist.twist.angular.z  # which nobody is to take for the turn rate where there is a gyro
    assert said == (pytest.approx(turn, abs=1e-3) if odometry == "wheel" else 0.0)
    assert imu.orientation_covariance[0] == -1.0


def test_the_cars_own_filter_is_where_it_went() -> None:
    stage = Stage("svea_overtaking", OVERTAKING, EXACT)
    stage.run(0.05)
    R0, p0 = (value.copy() for value in stage.pose("svea7"))
    stage.drive("svea7", 0.3, 0.3, 4.0)
    R, p = stage.pose("svea7")
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
    stage.drive("svea8", 0.2, 0.0, 5.0)
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


def test_a_moving_landmark_follows_its_motion_and_publishes_its_pose() -> None:
    stage = Stage("svea_crossing", CROSSING, EXACT)
    stage.reset(0)
    stage.run(6.0)
    R, p = stage.pose("svea3")
    assert_allclose(p, [-1.6 + 0.26 * 4.0, 1.45, 0.0], atol=0.005)
    assert_allclose(R, np.eye(3), atol=1e-9)
    said = stage.arrivals("svea3", Role.ESTIMATE)
    place = said[-1].pose.pose.position
    assert_allclose([place.x, place.y, place.z], p, atol=0.005)
    assert said[-1].header.frame_id == "map"
    assert len(said) == pytest.approx(360, abs=3)
    assert not stage.arrivals("svea3", Role.DETECTIONS) and not stage.arrivals("svea3", Role.WHEEL)
    assert len(stage.arrivals("svea3", Role.TRUTH)) == pytest.approx(600, abs=3)


FOCAL, CENTRE, SIZE = (213.161906, 213.521038), (154.841998, 114.98398), (316, 208)
DISTORTION = (-0.352043, 0.137879, 0.001953, 0.000628, 0.0)
BOX, BOX_CENTRE = np.array([0.586, 0.25, 0.25]), np.array([0.16, 0.0, 0.125])


def pixel(position: np.ndarray, yaw: float, target: np.ndarray) -> np.ndarray | None:
    """Return the exact pixel of a point; None: behind, beyond what the lens images, or beside the image."""
    forward, left, up = turned(yaw).T @ (target - position) - CAMERA
    if forward <= 0.0:
        return None
    x, y = -left / forward, -up / forward
    r2 = x * x + y * y
    k1, k2, p1, p2, _ = DISTORTION
    if 1.0 + 3.0 * k1 * r2 + 5.0 * k2 * r2 * r2 <= 0.0:  # the image of a ray farther out comes back
        return None
    g = 1.0 + k1 * r2 + k2 * r2**2
    u = FOCAL[0] * (x * g + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + CENTRE[0]
    v = FOCAL[1] * (y * g + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y) + CENTRE[1]
    return np.array([u, v]) if 0 <= u < SIZE[0] and 0 <= v < SIZE[1] else None


def hides(position: np.ndarray, yaw: float, target: np.ndarray, other: np.ndarray, other_yaw: float) -> bool | None:
    """Return whether the box of a car is before a target; None: only just."""
    eye = position + turned(yaw) @ CAMERA
    points = eye + np.linspace(0.0, 1.0, 4001)[:, None] * (target - eye)
    inside = np.abs((points - other) @ turned(other_yaw) - BOX_CENTRE) / (BOX / 2)
    depth = inside.max(axis=-1).min()
    return None if 0.97 < depth < 1.03 else bool(depth < 1.0)


def places(stage: Stage) -> dict[int, np.ndarray]:
    """Return where static markers are, by number."""
    return {MARKERS[mark.name]: np.array(mark.position) for mark in stage.scenario.landmarks if mark.name in MARKERS}


def frame(stage: Stage, car: str) -> tuple[Any, Any]:
    """Return the last frame as blocks and as the authors' bearings."""
    stage.forget()
    stage.run(0.04)
    return stage.arrivals(car, Role.DETECTIONS)[-1], stage.arrivals(car, Role.BEARINGS)[-1]


def test_pixels_of_many_poses() -> None:
    stage, rng = Stage("svea_overtaking", OVERTAKING, EXACT), np.random.default_rng(1)
    seen, unseen = 0, 0
    for _ in range(60):
        x, y, yaw = rng.uniform(-1.5, 1.5), rng.uniform(-2.0, 1.5), np.pi / 2 + rng.uniform(-0.8, 0.8)
        stage.put("svea7", x, y, yaw)
        stage.put("svea8", 20.0, 20.0, 0.0)
        blocks, unit = frame(stage, "svea7")
        found = {b.signature: (b.center_x, b.center_y) for b in blocks.objects}
        for number, place in places(stage).items():
            exact = pixel(np.array([x, y, 0.0]), yaw, place)
            if exact is None:
                assert number not in found
                unseen += 1
                continue
            assert_allclose(found[number], np.minimum(np.round(exact), [315, 207]), atol=0)
            seen += 1
        assert [b.id for b in unit.bearing] == [b.signature for b in blocks.objects]
        for b, g in zip(blocks.objects, unit.bearing, strict=True):
            v = np.array([(CENTRE[0] - b.center_x) / FOCAL[0], (CENTRE[1] - b.center_y) / FOCAL[1], -1.0])
            assert_allclose([g.bearing_x, g.bearing_y, g.bearing_z], v / np.linalg.norm(v), atol=1e-6)
    assert seen > 60 and unseen > 20


def test_cars_see_each_other_and_occlude_markers() -> None:
    """The other car is where motion capture has it: a message of another fake."""
    stage, rng = Stage("svea_overtaking", OVERTAKING, EXACT), np.random.default_rng(2)
    hidden, cars = 0, 0
    for _ in range(60):
        x, y, yaw = rng.uniform(-0.5, 0.5), rng.uniform(-2.0, 0.0), np.pi / 2 + rng.uniform(-0.3, 0.3)
        ox, oy, oyaw = x + rng.uniform(-0.5, 0.5), y + rng.uniform(0.8, 2.0), rng.uniform(-3.0, 3.0)
        stage.put("svea8", x, y, yaw)
        stage.put("svea7", ox, oy, oyaw)
        found = {b.signature for b in frame(stage, "svea8")[0].objects}
        position, other = np.array([x, y, 0.0]), np.array([ox, oy, 0.0])
        carried = other + turned(oyaw) @ MARKER
        assert (7 in found) == (pixel(position, yaw, carried) is not None)
        cars += 7 in found
        for number, place in places(stage).items():
            blocked = hides(position, yaw, place, other, oyaw)
            if blocked is not None:
                assert (number in found) == (pixel(position, yaw, place) is not None and not blocked)
                hidden += blocked
    assert hidden > 10 and cars > 30


def test_a_leader_sees_its_follower_too() -> None:
    """A camera knows nothing of the order in which vehicles may hear each other."""
    stage = Stage("svea_overtaking", OVERTAKING, EXACT)
    stage.put("svea7", 0.0, -2.0, np.pi / 2)
    stage.put("svea8", 0.1, -1.0, np.pi / 2)
    assert 6 in {b.signature for b in frame(stage, "svea7")[0].objects}


def test_blocks_are_as_large_as_they_are_near_and_the_largest_comes_first() -> None:
    stage = Stage("svea_overtaking", OVERTAKING, EXACT)
    stage.put("svea8", 20.0, 0.0, 0.0)
    sizes = []
    for y in (-2.5, -1.0, 0.0):
        stage.put("svea7", 0.0, y, np.pi / 2)
        blocks = frame(stage, "svea7")[0].objects
        areas = [b.width * b.height for b in blocks]
        assert areas == sorted(areas, reverse=True)
        sizes.append(areas[0])
    assert sizes == sorted(sizes) and sizes[0] < sizes[2]
    assert all(1 <= b.age <= 255 for b in blocks)
    assert max(b.age for b in blocks) > 2


def test_an_empty_frame_is_a_frame() -> None:
    stage = Stage("svea_overtaking", OVERTAKING, EXACT)
    stage.put("svea7", 0.0, 0.0, -np.pi / 2)
    stage.put("svea8", 0.0, 1.5, 0.0)
    stage.run(0.04)
    stage.forget()
    stage.run(1.0)
    frames = stage.arrivals("svea7", Role.DETECTIONS)
    assert len(frames) == pytest.approx(60, abs=2) and not any(m.objects for m in frames)


def test_the_moving_landmark_is_seen_once_its_car_is_there() -> None:
    both, alone = (Stage("svea_crossing", cars, EXACT) for cars in (CROSSING, CROSSING[:1]))
    for stage, expected in ((both, True), (alone, False)):
        stage.reset(0)
        stage.run(7.0)
        stage.put("svea7", 0.0, -1.0, np.pi / 2)
        assert (3 in {b.signature for b in frame(stage, "svea7")[0].objects}) == expected
