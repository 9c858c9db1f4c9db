"""Messages, decoded by rosbags from ROS 1 or ROS 2, as checked values in this project's conventions."""

from collections.abc import Callable, Collection
from typing import Any

import numpy as np

from coopenv.errors import CoopenvError, listed, shown
from coopenv.svea.conditions import battery_of, calibration_of, remote_of, state_of
from coopenv.svea.frames import bearings, detections
from coopenv.svea.numbers import covariance_of, vector
from coopenv.svea.quaternions import rotation_of, rotation_vector_of
from coopenv.svea.samples import Array, Calibration, Pose, Report, Twist, Value
from coopenv.svea.topics import Role

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


def _report(message: Any) -> Report:
    """Return what `robust` sent; `extra` as its messages have it."""
    if not message.valid:
        return Report(None, None, None, {})
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
    return Report(pose.position, pose.rotation, covariance_of(message.covariance, "covariance"), extra)


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
