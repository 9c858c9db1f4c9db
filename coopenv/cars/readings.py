"""Decoded messages as checked values in this project's conventions, from ROS 1 or ROS 2."""

from collections.abc import Callable, Collection
from typing import Any

import numpy as np

from coopenv.base.errors import CoopenvError, listed, shown
from coopenv.cars.deployment import MOST_CHANNELS
from coopenv.cars.lens import bearings, detections
from coopenv.cars.profile import CarProfile, Role
from coopenv.cars.samples import (
    Array,
    Calibration,
    CarStatus,
    Pose,
    RobustReport,
    Twist,
    Value,
    covariance_of,
    numbers_of,
    rotation_of,
    rotation_vector_of,
    vector,
)

LONGEST_MODE = 64  # characters


def calibration_of(message: Any) -> Calibration:
    """Return the intrinsics of a CameraInfo; ROS 1 writes their names large."""
    size = (int(message.width), int(message.height))
    if not all(0 < side <= 100_000 for side in size):
        raise CoopenvError(f"width, height: {size} is no image")
    if message.distortion_model not in ("plumb_bob", ""):
        raise CoopenvError(f"distortion_model: {shown(message.distortion_model)}, expected 'plumb_bob'")
    matrix = numbers_of(getattr(message, "k", getattr(message, "K", ())), "k", 1e6)
    given = numbers_of(getattr(message, "d", getattr(message, "D", ())), "d", 1e6)
    if matrix.shape != (9,) or min(matrix[0], matrix[4]) <= 0.0 or matrix[1] != 0.0:
        raise CoopenvError("k: no camera matrix with two positive focal lengths and no skew")
    if given.shape not in ((0,), (4,), (5,)):
        raise CoopenvError(f"d: {given.size} numbers, expected k1, k2, p1, p2, k3")
    k1, k2, p1, p2, k3 = (*map(float, given), *[0.0] * (5 - given.size))
    focal, centre = (float(matrix[0]), float(matrix[4])), (float(matrix[2]), float(matrix[5]))
    return Calibration(size, focal, centre, (k1, k2, p1, p2, k3))


def state_of(message: Any) -> CarStatus:
    """Return whether a car's autopilot is armed and connected, and in which mode."""
    return CarStatus(armed=bool(message.armed and message.connected), mode=str(message.mode)[:LONGEST_MODE])


def remote_of(message: Any) -> CarStatus:
    """Return the pulses of a car's remote control; none with a signal strength of 0, and 255 says: not known."""
    return CarStatus(pulses=tuple(int(pulse) for pulse in message.channels[:MOST_CHANNELS]) if message.rssi else ())


def battery_of(message: Any) -> CarStatus:
    """Return the share that is left; NaN and -1 say: not known."""
    share = float(message.percentage)
    if np.isnan(share) or share == -1.0:
        return CarStatus()
    if not 0.0 <= share <= 1.0:
        raise CoopenvError(f"percentage: {share:g} is not in 0..1")
    return CarStatus(battery=share)


FARTHEST, FASTEST, SPINNING = 1e7, 200.0, 100.0
"""m, m/s and rad/s beyond which a value is no car's."""


def read(
    role: Role,
    message: Any,
    calibration: Calibration | None = None,
    *,
    distorted: bool = True,
    known: Collection[int] | None = None,
) -> Value:
    """Return what a message tells.

    Args:
        role: of its topic.
        message: as rosbags decodes it.
        calibration: of the camera; needed for pixels, and for bearings that were made without removing distortion.
        distorted: whether `bearings` were made so.
        known: markers that there are; detections of others are dropped and counted (None: all count).

    Raises:
        CoopenvError: one line that names the role and the field: a type that the role has not, a value that is not
            finite or is absurd, a quaternion without length 1, or no calibration where one is needed.
    """
    kind = getattr(message, "__msgtype__", type(message).__name__)
    readers = READERS.get(role, {})
    if kind not in readers:
        raise CoopenvError(f"{role}: type {shown(kind)} is none of {listed(list(readers)) or 'those that are read'}")
    try:
        if role is Role.DETECTIONS:
            return detections(message, _needed(calibration), known)
        if role is Role.BEARINGS:
            return bearings(message, _needed(calibration) if distorted else None, known)
        return readers[kind](message)
    except CoopenvError as error:
        raise CoopenvError(f"{role}: {error}") from None


def _needed(calibration: Calibration | None) -> Calibration:
    if calibration is None:
        raise CoopenvError("the camera's calibration is not known")
    return calibration


def _twist(message: Any) -> Twist:
    """Return the velocities of a TwistWithCovarianceStamped; a negative variance says: not measured."""
    with_covariance = message.twist
    linear, angular = _velocities(with_covariance.twist)
    variances = np.asarray(with_covariance.covariance, dtype=np.float64).reshape(6, 6).diagonal()
    return Twist(None if variances[0] < 0.0 else linear, None if variances[5] < 0.0 else angular)


def _plain_twist(message: Any) -> Twist:
    return Twist(*_velocities(message.twist))


def _own_odometry(message: Any) -> Twist:
    """Return the twist of an Odometry, which is in the child frame."""
    return Twist(*_velocities(message.twist.twist))


def _velocities(twist: Any) -> tuple[Array, Array]:
    return vector(twist.linear, "twist.linear", FASTEST), vector(twist.angular, "twist.angular", SPINNING)


def _turning(message: Any) -> Twist:
    """Return the turn rate of an Imu; -1 as first covariance says: not measured."""
    if float(message.angular_velocity_covariance[0]) == -1.0:
        return Twist(None, None)
    return Twist(None, vector(message.angular_velocity, "angular_velocity", SPINNING))


def _pose(message: Any) -> Pose:
    return _placed(message.pose)


def _pose_with_covariance(message: Any) -> Pose:
    """Return the pose of a PoseWithCovarianceStamped or Odometry; a covariance of zeros says: not known."""
    pose = _placed(message.pose.pose)
    covariance = covariance_of(message.pose.covariance, "pose.covariance")
    return Pose(pose.position, pose.rotation, covariance if covariance.any() else None)


def _placed(pose: Any) -> Pose:
    return Pose(vector(pose.position, "pose.position", FARTHEST), rotation_of(pose.orientation, "pose.orientation"))


def _point(message: Any) -> Pose:
    return Pose(vector(message.point, "point", FARTHEST))


def _report(message: Any) -> RobustReport:
    """Return what `robust` sent; `extra` as its messages have it."""
    if not message.valid:
        return RobustReport(None, None, None, {})
    pose, odometry = _placed(message.pose), message.odometry
    moved = vector(odometry.position, "odometry.position", FARTHEST)
    turned = rotation_vector_of(odometry.orientation, "odometry.orientation")
    extra: dict[str, Any] = {
        "odometry": np.concatenate([turned, moved]),
        "depends_on": np.array([message.depends_on], dtype=np.uint64),
        "told": np.zeros(0, np.uint16),  # a report counts; of correlations it has none
        "ages": np.zeros(0, np.float32),
        "correlations": np.zeros((0, 6, 6), np.int8),
    }
    return RobustReport(pose.position, pose.rotation, covariance_of(message.covariance, "covariance"), extra)


POSES: dict[str, Callable[[Any], Value]] = {
    "geometry_msgs/msg/PoseStamped": _pose,
    "geometry_msgs/msg/PoseWithCovarianceStamped": _pose_with_covariance,
    "nav_msgs/msg/Odometry": _pose_with_covariance,
}
TWISTS: dict[str, Callable[[Any], Value]] = {
    "geometry_msgs/msg/TwistWithCovarianceStamped": _twist,
    "geometry_msgs/msg/TwistStamped": _plain_twist,
    "nav_msgs/msg/Odometry": _own_odometry,
}
READERS: dict[Role, dict[str, Callable[..., Value]]] = {
    Role.DETECTIONS: {"pixy_camera/msg/ObjectInfoArrayStamped": detections},
    Role.BEARINGS: {"pixy_camera/msg/ObjectBearingArrayStamped": bearings},
    Role.CAMERA_INFO: {"sensor_msgs/msg/CameraInfo": calibration_of},
    Role.ODOMETRY: TWISTS,
    Role.WHEEL: TWISTS,
    Role.IMU: {"sensor_msgs/msg/Imu": _turning},
    Role.ESTIMATE: POSES,
    Role.POINT: {"geometry_msgs/msg/PointStamped": _point},
    Role.REPORT: {"coopenv_msgs/msg/RobustReport": _report},
    Role.TRUTH: POSES,
    Role.STATE: {"mavros_msgs/msg/State": state_of},
    Role.REMOTE: {"mavros_msgs/msg/RCIn": remote_of},
    Role.BATTERY: {"sensor_msgs/msg/BatteryState": battery_of},
}
"""Types of a role, and what reads them; roles of commands are not here."""


def check_types(profile: CarProfile, where: str) -> None:
    """Refuse a profile with a type that cannot be read in its role, with a CoopenvError that begins with `where`."""
    for role, readers in READERS.items():
        if (kind := profile.topics[role].type) not in readers:
            raise CoopenvError(f"{where}: profile: topics.{role}.type: {kind} is none of {listed(list(readers))}")
