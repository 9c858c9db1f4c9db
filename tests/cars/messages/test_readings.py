"""Readings of sensors' messages, and rays through a lens."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from coopenv import CoopenvError
from coopenv.cars.messages import codec
from coopenv.cars.messages.readings import (
    READERS,
    CarPose,
    CarStatus,
    Detections,
    Sample,
    Twist,
    read,
    without_outliers,
)
from coopenv.cars.messages.vision import Calibration, rays
from coopenv.cars.settings.profile import SVEA, Role
from coopenv.estimation.lens import distort
from coopenv.observers.contract import Message

pytest.importorskip("rosbags", reason="needs the extra 'svea'")

DISTORTION = (-0.352043, 0.137879, 0.001953, 0.000628, 0.0)
CAMERA = Calibration((316, 208), (213.161906, 213.521038), (154.841998, 114.98398), DISTORTION)


def make(kind: str, ros: int = 2, **fields: Any) -> Any:
    """Return a message that has gone through bytes."""
    message = codec.make(kind, header=codec.header(5), **fields)
    if ros == 2:
        return codec.decode(codec.encode(message), kind)
    return codec.ros1().deserialize_ros1(codec.ros1_of(codec.encode(message), kind), kind)


def pose(p: Any = (1, 2, 3), q: Any = (0, 0, 0, 1), covariance: Any = None) -> dict[str, Any]:
    """Return the fields of a pose with covariance."""
    return {"pose": (p, q), "covariance": covariance}


def blocks(*rows: tuple[int, int, int, int, int], ros: int = 2) -> Any:
    objects = [codec.make("pixy_camera/msg/ObjectInfo", **dict(zip(BLOCK, row, strict=True))) for row in rows]
    return make("pixy_camera/msg/ObjectInfoArrayStamped", ros, objects=objects)


BLOCK = ("signature", "center_x", "center_y", "width", "height")


def vectors(*rows: tuple[int, float, float, float]) -> Any:
    names = ("id", "bearing_x", "bearing_y", "bearing_z")
    bearing = [codec.make("pixy_camera/msg/ObjectBearing", **dict(zip(names, row, strict=True))) for row in rows]
    return make("pixy_camera/msg/ObjectBearingArrayStamped", bearing=bearing)


@pytest.mark.parametrize("ros", [1, 2])
def test_pixels_become_rays_without_distortion(ros: int) -> None:
    frame = read(Role.DETECTIONS, blocks((4, 250, 60, 9, 9), (2, 30, 150, 9, 9), ros=ros), CAMERA)
    assert isinstance(frame, Detections) and frame.markers == (2, 4) and frame.dropped == 0
    flat = frame.bearings[:, :2] / frame.bearings[:, 2:]
    pixels = distort(flat, DISTORTION) * CAMERA.focal_length + np.array(CAMERA.principal_point)
    assert_allclose(pixels, [[30, 150], [250, 60]], atol=1e-6)
    assert_allclose(np.linalg.norm(frame.bearings, axis=1), 1.0)


def test_the_largest_block_of_a_marker_counts_and_others_are_counted() -> None:
    rows = [(1, 50, 50, 4, 4), (1, 100, 50, 8, 8), (1, 150, 50, 2, 2), (9, 60, 60, 9, 9), (2, 316, 60, 9, 9)]
    frame = read(Role.DETECTIONS, blocks(*rows, (3, 60, 60, -1, 9)), CAMERA, known=(1, 2, 3))
    assert isinstance(frame, Detections) and frame.markers == (1,) and frame.dropped == 5
    alone = read(Role.DETECTIONS, blocks((1, 100, 50, 8, 8)), CAMERA)
    assert isinstance(alone, Detections)
    assert_allclose(frame.bearings, alone.bearings, atol=1e-14)


def test_an_empty_frame_is_a_frame() -> None:
    for frame in (read(Role.DETECTIONS, blocks(), CAMERA), read(Role.BEARINGS, vectors(), CAMERA)):
        assert isinstance(frame, Detections) and frame.markers == () and frame.bearings.shape == (0, 3)


def test_the_authors_vectors_give_the_rays_of_their_pixels() -> None:
    pixels = [(4, 250, 60), (2, 30, 150)]
    made = []
    for marker, u, v in pixels:  # as their node does: minus the ray, distortion and all
        b = np.array([(u - 154.841998) / 213.161906, (v - 114.98398) / 213.521038, 1.0])
        made.append((marker, *(-b / np.linalg.norm(b))))
    of_vectors = read(Role.BEARINGS, vectors(*made), CAMERA)
    of_pixels = read(Role.DETECTIONS, blocks(*((m, u, v, 9, 9) for m, u, v in pixels)), CAMERA)
    assert isinstance(of_vectors, Detections) and isinstance(of_pixels, Detections)
    assert of_vectors.markers == of_pixels.markers
    assert_allclose(of_vectors.bearings, of_pixels.bearings, atol=1e-5)


def test_vectors_without_distortion_only_turn_round() -> None:
    frame = read(
        Role.BEARINGS, vectors((1, 0.6, 0.0, 0.8), (1, 0, 0, 1), (2, 0, 0, 2), (3, np.nan, 0, 1)), distorted=False
    )
    assert isinstance(frame, Detections) and frame.markers == (1,) and frame.dropped == 3
    assert_allclose(frame.bearings, [[-0.6, 0.0, -0.8]], atol=1e-7)


def test_velocities() -> None:
    kind, twist = "geometry_msgs/msg/TwistWithCovarianceStamped", ((1, 0, 0), (0, 0, 0.5))
    value = read(Role.WHEEL, make(kind, twist={"twist": twist}))
    assert isinstance(value, Twist) and value.linear is not None and value.angular is not None
    assert value.linear.tolist() == [1, 0, 0] and value.angular.tolist() == [0, 0, 0.5]
    unmeasured = {"twist": twist, "covariance": np.diag([1, 1, 1, 1, 1, -1.0])}
    half = read(Role.WHEEL, make(kind, twist=unmeasured))
    assert isinstance(half, Twist) and half.angular is None and half.linear is not None
    own = make("nav_msgs/msg/Odometry", pose=pose(), twist={"twist": ((2, 0, 0), (0, 0, 0))})
    moved, truth = read(Role.ODOMETRY, own), read(Role.TRUTH, own)
    assert isinstance(moved, Twist) and moved.linear is not None and moved.linear.tolist() == [2, 0, 0]
    assert isinstance(truth, CarPose) and truth.position.tolist() == [1, 2, 3] and truth.covariance is None


def imu(first: float = 0.0, w: Any = (0.1, 0.2, 0.3)) -> Any:
    return make("sensor_msgs/msg/Imu", angular_velocity=w, angular_velocity_covariance=[first, *np.zeros(8)])


def test_turn_rates() -> None:
    value = read(Role.IMU, imu())
    assert isinstance(value, Twist) and value.linear is None and value.angular is not None
    assert value.angular.tolist() == [0.1, 0.2, 0.3]
    assert read(Role.IMU, imu(-1.0)) == Twist(None, None)


ESTIMATE = "geometry_msgs/msg/PoseWithCovarianceStamped"


def test_poses_and_points() -> None:
    turn = Rotation.from_rotvec([0.3, -0.2, 2.0])
    P = np.diag([1.0, 2, 3, 4, 5, 6])
    value = read(Role.ESTIMATE, make(ESTIMATE, pose=pose(q=turn.as_quat(), covariance=P)))
    assert isinstance(value, CarPose) and value.rotation is not None
    assert_allclose(value.rotation, turn.as_matrix(), atol=1e-12)
    assert_array_equal(value.covariance, P)
    for ros in (1, 2):
        seen = read(Role.TRUTH, make("geometry_msgs/msg/PoseStamped", ros, pose=((1, 2, 3), turn.as_quat())))
        assert isinstance(seen, CarPose) and seen.rotation is not None
        assert_allclose(seen.rotation, turn.as_matrix(), atol=1e-12)
    reading = read(Role.POINT, make("geometry_msgs/msg/PointStamped", 1, point=(1, 2, 3)))
    assert isinstance(reading, CarPose) and reading.position.tolist() == [1, 2, 3] and reading.rotation is None


def skew(value: float) -> Any:
    """Return the covariance of standard deviations 1, 2, ... that is asymmetric by a value in one place."""
    covariance = np.diag(np.arange(1.0, 7.0) ** 2)
    covariance[0, 5] += value
    return covariance


UNKNOWN = {
    "zeros": np.zeros(36),
    "-1": [-1.0, *np.zeros(35)],
    "negative": -np.eye(6),
    "NaN": np.full(36, np.nan),
    "NaN within": np.diag([1, 1, 1, 1, 1, np.nan]),
    "infinite": np.diag([1, 1, 1, 1, 1, np.inf]),
    "asymmetric": skew(0.3),
}


@pytest.mark.parametrize("name", UNKNOWN)
@pytest.mark.parametrize("kind", ["nav_msgs/msg/Odometry", ESTIMATE])
def test_a_pose_counts_with_any_covariance(kind: str, name: str) -> None:
    message = make(kind, pose=pose(covariance=UNKNOWN[name]))
    for role in (Role.TRUTH, Role.ESTIMATE):
        value = read(role, message)
        assert isinstance(value, CarPose) and value.covariance is None and value.position.tolist() == [1, 2, 3]


def test_a_covariance_that_is_symmetric_but_for_rounding_is_symmetric() -> None:
    value = read(Role.ESTIMATE, make(ESTIMATE, pose=pose(covariance=skew(5e-3))))
    assert isinstance(value, CarPose)
    assert_allclose(value.covariance, 0.5 * (skew(5e-3) + skew(5e-3).T), atol=1e-15)


@pytest.mark.parametrize("length", [0.96, 1.0, 1.04])
def test_quaternions_a_few_per_cent_long_are_normalised(length: float) -> None:
    turn = Rotation.from_rotvec([0.3, -0.2, 2.0])
    value = read(Role.TRUTH, posed((1, 2, 3), length * turn.as_quat()))
    assert isinstance(value, CarPose) and value.rotation is not None
    assert_allclose(value.rotation, turn.as_matrix(), atol=1e-12)


def test_unmeasured_velocities_are_none() -> None:
    unmeasured = {"twist": ((2, 0, 0), (0, 0, 0)), "covariance": np.diag([1, 1, 1, 1, 1, -1.0])}
    value = read(Role.WHEEL, make("nav_msgs/msg/Odometry", pose=pose(), twist=unmeasured))
    assert isinstance(value, Twist) and value.angular is None and value.linear is not None


REPORT = "coopenv_msgs/msg/RobustReport"


def test_velocities_that_are_not_measured_may_be_nan() -> None:
    nan, kind = np.nan, "geometry_msgs/msg/TwistStamped"
    turning = read(Role.WHEEL, make(kind, twist=((2, nan, nan), (nan, nan, 0.5))))
    assert isinstance(turning, Twist) and turning.linear is not None and turning.angular is not None
    assert turning.linear.tolist() == [2, 0, 0] and turning.angular.tolist() == [0, 0, 0.5]
    straight = read(Role.WHEEL, make(kind, twist=((2, 0, 0), (nan, nan, nan))))
    assert isinstance(straight, Twist) and straight.angular is None
    for wrong in ((nan, 0, 0), (np.inf, 0, 0)):
        with pytest.raises(CoopenvError, match=r"wheel: twist\.linear"):
            read(Role.WHEEL, make(kind, twist=(wrong, (0, 0, 0))))


def report(covariance: Any) -> dict[str, Any]:
    """Return the fields of a report with a covariance."""
    return {"pose": ((1, 2, 3), (0, 0, 0, 1)), "odometry": ((4, 5, 6), (0, 0, 0, 1)), "covariance": covariance}


def test_reports() -> None:
    turn = Rotation.from_rotvec([0.1, 0.0, -3.0])
    fields = {"pose": ((1, 2, 3), turn.as_quat()), "covariance": np.eye(6)}
    fields |= {"odometry": ((4, 5, 6), -turn.as_quat()), "depends_on": 2**63 + 1}
    value = read(Role.REPORT, make(REPORT, valid=True, **fields))
    assert isinstance(value, Message) and value.rotation is not None
    assert_allclose(value.extra["odometry"], [*turn.as_rotvec(), 4, 5, 6], atol=1e-12)
    assert value.extra["depends_on"].dtype == np.uint64 and int(value.extra["depends_on"][0]) == 2**63 + 1
    lost = read(Role.REPORT, make(REPORT, valid=False, **fields))
    assert lost == Message()


def camera_info(ros: int, **other: Any) -> Any:
    matrices = {"d": DISTORTION, "k": [213.0, 0, 155.0, 0, 214.0, 115.0, 0, 0, 1]}
    fields = {"height": 208, "width": 316, "distortion_model": "plumb_bob", **matrices, **other}
    return make("sensor_msgs/msg/CameraInfo", ros, **fields)


@pytest.mark.parametrize("ros", [1, 2])
def test_calibrations(ros: int) -> None:
    expected = Calibration((316, 208), (213.0, 214.0), (155.0, 115.0), DISTORTION)
    assert read(Role.CAMERA_INFO, camera_info(ros)) == expected
    for none in ({"d": []}, {"d": [0.0] * 5, "distortion_model": "none"}, {"d": [], "distortion_model": "pinhole"}):
        assert read(Role.CAMERA_INFO, camera_info(ros, **none)) == replace(expected, distortion=(0.0,) * 5)


def battery(share: float) -> Any:
    return make("sensor_msgs/msg/BatteryState", percentage=share)


def test_status() -> None:
    for connected in (True, False):
        state = make("mavros_msgs/msg/State", connected=connected, armed=True, mode="MANUAL")
        assert read(Role.STATE, state) == CarStatus(armed=connected, mode="MANUAL")
    for rssi, pulses, kept in ((9, [1500, 1510], (1500, 1510)), (0, [1500, 1510], ()), (255, [], ()), (255, [0], (0,))):
        assert read(Role.REMOTE, make("mavros_msgs/msg/RCIn", rssi=rssi, channels=pulses)) == CarStatus(pulses=kept)
    assert read(Role.BATTERY, battery(0.5)) == CarStatus(battery=0.5)
    assert read(Role.BATTERY, battery(float("nan"))) == CarStatus()


def posed(p: Any, q: Any) -> Any:
    return make("geometry_msgs/msg/PoseStamped", pose=(p, q))


WRONG: list[tuple[Role, Any, str]] = [
    (Role.IMU, lambda: imu(w=(0, 0, np.nan)), "imu: angular_velocity: "),
    (Role.IMU, lambda: imu(w=(0, 0, 1e5)), "imu: angular_velocity: .*beyond 100"),
    (
        Role.TRUTH,
        lambda: posed((1, 2, 3), (0, 0, 0, 0)),
        "truth: pose.orientation: no unit quaternion, its length is 0",
    ),
    (Role.TRUTH, lambda: posed((0, np.inf, 0), (0, 0, 0, 1)), "truth: pose.position: "),
    (Role.TRUTH, lambda: imu(), "truth: type 'sensor_msgs/msg/Imu' is none of geometry_msgs/msg/PoseStamped"),
    (Role.TRUTH, lambda: posed((1, 2, 3), (0, 0, 0, 1.1)), "truth: pose.orientation: .* its length is 1.1"),
    (
        Role.REPORT,
        lambda: make(REPORT, valid=True, **report(-np.eye(6))),
        "report: covariance",
    ),
    (Role.DETECTIONS, lambda: blocks((1, 5, 5, 1, 1)), "detections: the camera's calibration is not known"),
    (Role.CAMERA_INFO, lambda: camera_info(2, distortion_model="wide"), "camera_info: distortion_model: "),
    (Role.CAMERA_INFO, lambda: camera_info(2, d=[1.0, 2.0]), "camera_info: d: 2 numbers"),
    (Role.CAMERA_INFO, lambda: camera_info(1, k=np.zeros(9)), "camera_info: k: "),
    (Role.BATTERY, lambda: battery(40.0), "battery: percentage: 40 "),
    (Role.STOP, lambda: codec.make("std_msgs/msg/Bool", data=True), "estop|stop: type "),
]


@pytest.mark.parametrize(("role", "made", "line"), WRONG)
def test_absurd_values_are_one_line(role: Role, made: Any, line: str) -> None:
    with pytest.raises(CoopenvError, match=line) as caught:
        read(role, made())
    assert "\n" not in str(caught.value)


def test_every_topic_of_a_car_that_is_no_command_can_be_read() -> None:
    commands = {Role.COMMAND, Role.ARM, Role.GATE, Role.STOP, Role.MANUAL}
    assert all(topic.type in READERS[role] for role, topic in SVEA.topics.items() if role not in commands)


def test_rays_of_pixels_go_right_and_down() -> None:
    pixels = np.array([CAMERA.principal_point, (250.0, 115.0), (155.0, 200.0), (316.0, 10.0), (-1.0, 10.0)])
    directions, there = rays(pixels, CAMERA)
    assert there.tolist() == [True, True, True, False, False]
    assert_allclose(directions[0], [0.0, 0.0, 1.0], atol=1e-15)
    assert directions[1, 0] > 0.4 and directions[2, 1] > 0.35
    assert_allclose(np.linalg.norm(directions, axis=1), 1.0)


def test_single_velocities_of_no_car_are_left_out_and_a_topic_in_another_unit_is_not() -> None:
    fast = {"twist": ((450.0, 0.0, 0.0), (0.0, 0.0, 0.0))}
    value = read(Role.WHEEL, make(SVEA.topics[Role.WHEEL].type, twist=fast), any_unit=True)
    assert isinstance(value, Twist) and value.linear is not None and value.linear[0] == 450.0
    slow = Twist(np.array([0.4, 0.0, 0.0]), None)
    some = [Sample("car", Role.WHEEL, n, n, value if n == 50 else slow) for n in range(100)]
    refused = Counter[str]()
    assert [s.stamp for s in without_outliers(some, refused)] == [n for n in range(100) if n != 50]
    assert refused.total() == 1 and "beyond 200" in next(iter(refused))
    in_mm = [replace(s, value=value if n % 10 == 0 else slow) for n, s in enumerate(some)]
    assert without_outliers(in_mm, refused) == in_mm and refused.total() == 1
