"""Messages as values: signs, frames, units, and one line for what makes no sense."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from coopenv import CoopenvError
from coopenv.cars import codec
from coopenv.cars.profile import SVEA, Role
from coopenv.cars.readings import Calibration, CarPose, CarStatus, Detections, RobustReport, Twist, read
from coopenv.cars.transport.authors import to_ros1
from coopenv.estimation.lens import distort

pytest.importorskip("rosbags", reason="needs the extra 'svea'")

DISTORTION = (-0.352043, 0.137879, 0.001953, 0.000628, 0.0)
CAMERA = Calibration((316, 208), (213.161906, 213.521038), (154.841998, 114.98398), DISTORTION)


def make(kind: str, ros: int = 2, **fields: Any) -> Any:
    """Return a message that has gone through bytes."""
    store = codec.ros2() if ros == 2 else codec.ros1()
    message = store.types[kind](**fields)
    if ros == 2:
        return store.deserialize_cdr(store.serialize_cdr(message, kind), kind)
    return store.deserialize_ros1(store.serialize_ros1(message, kind), kind)


def head(ros: int = 2) -> Any:
    return codec.header(5) if ros == 2 else to_ros1(codec.header(5))


def vector(*xyz: float) -> Any:
    return codec.make("geometry_msgs/msg/Vector3", **dict(zip("xyz", map(float, xyz), strict=True)))


def pose(p: Any = (1, 2, 3), q: Any = (0, 0, 0, 1)) -> Any:
    point = codec.make("geometry_msgs/msg/Point", **dict(zip("xyz", map(float, p), strict=True)))
    turn = codec.make("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", map(float, q), strict=True)))
    return codec.make("geometry_msgs/msg/Pose", position=point, orientation=turn)


def twist(v: Any = (1, 0, 0), w: Any = (0, 0, 0.5)) -> Any:
    return codec.make("geometry_msgs/msg/Twist", linear=vector(*v), angular=vector(*w))


def with_covariance(kind: str, covariance: Any = None, **inner: Any) -> Any:
    values = np.zeros(36) if covariance is None else np.asarray(covariance, dtype=np.float64).ravel()
    return codec.make(f"geometry_msgs/msg/{kind}WithCovariance", covariance=values, **inner)


def blocks(*rows: tuple[int, int, int, int, int], ros: int = 2) -> Any:
    store = codec.ros2() if ros == 2 else codec.ros1()
    one = store.types["pixy_camera/msg/ObjectInfo"]
    objects = [one(*row, 0, 0, 0) for row in rows]
    return make("pixy_camera/msg/ObjectInfoArrayStamped", ros, header=head(ros), objects=objects)


def vectors(*rows: tuple[int, float, float, float]) -> Any:
    bearing = [
        codec.make("pixy_camera/msg/ObjectBearing", id=r[0], bearing_x=r[1], bearing_y=r[2], bearing_z=r[3])
        for r in rows
    ]
    return make("pixy_camera/msg/ObjectBearingArrayStamped", header=head(), bearing=bearing)


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
    wheel = make(
        "geometry_msgs/msg/TwistWithCovarianceStamped", header=head(), twist=with_covariance("Twist", twist=twist())
    )
    value = read(Role.WHEEL, wheel)
    assert isinstance(value, Twist) and value.linear is not None and value.angular is not None
    assert value.linear.tolist() == [1, 0, 0] and value.angular.tolist() == [0, 0, 0.5]
    unmeasured = with_covariance("Twist", np.diag([1, 1, 1, 1, 1, -1.0]), twist=twist())
    half = read(Role.WHEEL, make("geometry_msgs/msg/TwistWithCovarianceStamped", header=head(), twist=unmeasured))
    assert isinstance(half, Twist) and half.angular is None and half.linear is not None
    own = make(
        "nav_msgs/msg/Odometry",
        header=head(),
        child_frame_id="base_link",
        pose=with_covariance("Pose", pose=pose()),
        twist=with_covariance("Twist", twist=twist((2, 0, 0))),
    )
    moved, truth = read(Role.ODOMETRY, own), read(Role.TRUTH, own)
    assert isinstance(moved, Twist) and moved.linear is not None and moved.linear.tolist() == [2, 0, 0]
    assert isinstance(truth, CarPose) and truth.position.tolist() == [1, 2, 3] and truth.covariance is None


def imu(first: float = 0.0, w: Any = (0.1, 0.2, 0.3)) -> Any:
    covariance = np.array([first, *np.zeros(8)])
    return make(
        "sensor_msgs/msg/Imu",
        header=head(),
        orientation=pose().orientation,
        orientation_covariance=np.zeros(9),
        angular_velocity=vector(*w),
        angular_velocity_covariance=covariance,
        linear_acceleration=vector(0, 0, 9.8),
        linear_acceleration_covariance=np.zeros(9),
    )


def test_turn_rates() -> None:
    value = read(Role.IMU, imu())
    assert isinstance(value, Twist) and value.linear is None and value.angular is not None
    assert value.angular.tolist() == [0.1, 0.2, 0.3]
    assert read(Role.IMU, imu(-1.0)) == Twist(None, None)


def test_poses_and_points() -> None:
    turn = Rotation.from_rotvec([0.3, -0.2, 2.0])
    P = np.diag([1.0, 2, 3, 4, 5, 6])
    posed = with_covariance("Pose", P, pose=pose(q=turn.as_quat()))
    value = read(Role.ESTIMATE, make("geometry_msgs/msg/PoseWithCovarianceStamped", header=head(), pose=posed))
    assert isinstance(value, CarPose) and value.rotation is not None
    assert_allclose(value.rotation, turn.as_matrix(), atol=1e-12)
    assert_array_equal(value.covariance, P)
    for ros in (1, 2):
        stamped = make("geometry_msgs/msg/PoseStamped", ros, header=head(ros), pose=pose(q=turn.as_quat()))
        seen = read(Role.TRUTH, stamped)
        assert isinstance(seen, CarPose) and seen.rotation is not None
        assert_allclose(seen.rotation, turn.as_matrix(), atol=1e-12)
    point = make("geometry_msgs/msg/PointStamped", 1, header=head(1), point=pose().position)
    told = read(Role.POINT, point)
    assert isinstance(told, CarPose) and told.position.tolist() == [1, 2, 3] and told.rotation is None


def test_reports() -> None:
    turn = Rotation.from_rotvec([0.1, 0.0, -3.0])
    fields = {
        "header": head(),
        "pose": pose(q=turn.as_quat()),
        "covariance": np.eye(6).ravel(),
        "odometry": pose((4, 5, 6), -turn.as_quat()),
        "depends_on": 2**63 + 1,
    }
    value = read(Role.REPORT, make("coopenv_msgs/msg/RobustReport", valid=True, **fields))
    assert isinstance(value, RobustReport) and value.rotation is not None
    assert_allclose(value.extra["odometry"], [*turn.as_rotvec(), 4, 5, 6], atol=1e-12)
    assert value.extra["depends_on"].dtype == np.uint64 and int(value.extra["depends_on"][0]) == 2**63 + 1
    lost = read(Role.REPORT, make("coopenv_msgs/msg/RobustReport", valid=False, **fields))
    assert lost == RobustReport(None, None, None, {})


def camera_info(ros: int, **other: Any) -> Any:
    names = {
        "d": list(DISTORTION),
        "k": [213.0, 0, 155.0, 0, 214.0, 115.0, 0, 0, 1],
        "r": np.eye(3).ravel(),
        "p": np.zeros(12),
        **other,
    }
    arrays = {k if ros == 2 else k.upper(): np.asarray(v, dtype=np.float64) for k, v in names.items() if len(k) == 1}
    store = codec.ros2() if ros == 2 else codec.ros1()
    region = store.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    plain = {
        "height": 208,
        "width": 316,
        "distortion_model": "plumb_bob",
        **{k: v for k, v in other.items() if len(k) > 1},
    }
    return make(
        "sensor_msgs/msg/CameraInfo", ros, header=head(ros), binning_x=0, binning_y=0, roi=region, **arrays, **plain
    )


@pytest.mark.parametrize("ros", [1, 2])
def test_calibrations(ros: int) -> None:
    expected = Calibration((316, 208), (213.0, 214.0), (155.0, 115.0), DISTORTION)
    assert read(Role.CAMERA_INFO, camera_info(ros)) == expected
    assert read(Role.CAMERA_INFO, camera_info(ros, d=[])) == Calibration(*_parts(expected), (0.0,) * 5)  # type: ignore[arg-type]


def _parts(c: Calibration) -> Any:
    return c.image_size, c.focal_length, c.principal_point


def battery(share: float) -> Any:
    store = codec.ros2().types["sensor_msgs/msg/BatteryState"]
    numbers = dict.fromkeys(("voltage", "temperature", "current", "charge", "capacity", "design_capacity"), 1.0)
    flags = {f"power_supply_{what}": 0 for what in ("status", "health", "technology")}
    empty = np.zeros(0, dtype=np.float32)
    return store(
        header=head(),
        percentage=share,
        present=True,
        cell_voltage=empty,
        cell_temperature=empty,
        location="",
        serial_number="",
        **numbers,
        **flags,
    )


def test_status() -> None:
    state = make(
        "mavros_msgs/msg/State",
        header=head(),
        connected=True,
        armed=True,
        guided=False,
        manual_input=True,
        mode="MANUAL",
        system_status=4,
    )
    assert read(Role.STATE, state) == CarStatus(armed=True, mode="MANUAL")
    state.connected = False
    assert read(Role.STATE, state) == CarStatus(armed=False, mode="MANUAL")
    for rssi, pulses, told in ((9, [1500, 1510], (1500, 1510)), (0, [1500, 1510], ()), (255, [], ()), (255, [0], (0,))):
        remote = make("mavros_msgs/msg/RCIn", header=head(), rssi=rssi, channels=np.array(pulses, dtype=np.uint16))
        assert read(Role.REMOTE, remote) == CarStatus(pulses=told)
    assert read(Role.BATTERY, battery(0.5)) == CarStatus(battery=0.5)
    assert read(Role.BATTERY, battery(float("nan"))) == CarStatus()


WRONG: list[tuple[Role, Any, str]] = [
    (Role.IMU, lambda: imu(w=(np.nan, 0, 0)), "imu: angular_velocity: "),
    (Role.IMU, lambda: imu(w=(0, 0, 1e5)), "imu: angular_velocity: .*beyond 100"),
    (
        Role.TRUTH,
        lambda: make("geometry_msgs/msg/PoseStamped", header=head(), pose=pose(q=(0, 0, 0, 0))),
        "truth: pose.orientation: no unit quaternion, its length is 0",
    ),
    (
        Role.TRUTH,
        lambda: make("geometry_msgs/msg/PoseStamped", header=head(), pose=pose((0, np.inf, 0))),
        "truth: pose.position: ",
    ),
    (Role.TRUTH, lambda: imu(), "truth: type 'sensor_msgs/msg/Imu' is none of geometry_msgs/msg/PoseStamped"),
    (
        Role.ESTIMATE,
        lambda: make(
            "geometry_msgs/msg/PoseWithCovarianceStamped",
            header=head(),
            pose=with_covariance("Pose", -np.eye(6), pose=pose()),
        ),
        "estimate: pose.covariance: ",
    ),
    (Role.DETECTIONS, lambda: blocks((1, 5, 5, 1, 1)), "detections: the camera's calibration is not known"),
    (Role.CAMERA_INFO, lambda: camera_info(2, distortion_model="equidistant"), "camera_info: distortion_model: "),
    (Role.CAMERA_INFO, lambda: camera_info(2, d=[1.0, 2.0]), "camera_info: d: 2 numbers"),
    (Role.CAMERA_INFO, lambda: camera_info(1, k=np.zeros(9)), "camera_info: k: "),
    (Role.BATTERY, lambda: battery(40.0), "battery: percentage: 40 "),
    (Role.STOP, lambda: codec.make("std_msgs/msg/Bool", data=True), "estop|stop: type "),
]


@pytest.mark.parametrize(("role", "made", "line"), WRONG)
def test_what_makes_no_sense_is_one_line(role: Role, made: Any, line: str) -> None:
    with pytest.raises(CoopenvError, match=line) as caught:
        read(role, made())
    assert "\n" not in str(caught.value)


def test_every_topic_of_a_car_that_is_no_command_can_be_read() -> None:
    from coopenv.cars.readings import READERS

    commands = {Role.COMMAND, Role.ARM, Role.GATE, Role.STOP, Role.MANUAL}
    assert all(topic.type in READERS[role] for role, topic in SVEA.topics.items() if role not in commands)
