"""What cars tell each other: estimates as ROS has them, and this project's messages to observers."""

from typing import Any, cast

import numpy as np
from scipy.spatial.transform import Rotation

from coopenv.backends.base import Told
from coopenv.estimation.arrays import Array
from coopenv.estimation.rotations import skew
from coopenv.observers.contract import Message
from coopenv.observers.riccati_coordinates import left_covariance
from coopenv.observers.robust.messages import from_six
from coopenv.svea.codec import header, make
from coopenv.svea.samples import Pose, Report


def message_of(value: Pose | Report, marker: Array) -> Message:
    """Return what an observer reads of a sender whose marker is at `marker` (3,) in its body, m.

    A position without an orientation gives the marker's height alone.
    """
    if isinstance(value, Report):
        return Message(value.position, value.rotation, value.covariance, cast(dict[str, Array], value.extra))
    if value.rotation is None:
        return Message(value.position + np.array([0.0, 0.0, marker[2]]))
    arm = value.rotation @ marker
    covariance = None
    if value.covariance is not None:
        J = np.hstack([np.eye(3), -skew(arm)])  # of the marker's place by those of position and rotation
        covariance = J @ value.covariance @ J.T
    return Message(value.position + arm, value.rotation, covariance)


def estimate_message(told: Told, stamp: int, origin: Array) -> Any:
    """Return the PoseWithCovarianceStamped of an estimate; rotations of its covariance are about the map's axes.

    `origin` (3,) is that of the map in the coordinates of the scenario's file, which are those on the wire.
    """
    P = left_covariance(told.rotation.T @ told.position, told.covariance)
    turn = np.zeros((6, 6))
    turn[:3, 3:] = turn[3:, :3] = told.rotation  # (theta, rho) in the body to (position, rotation) in the map
    pose, covariance = _pose(told.rotation, told.position + origin), (turn @ P @ turn.T).ravel()
    return make(
        "geometry_msgs/msg/PoseWithCovarianceStamped",
        header=header(stamp, "map"),
        pose=make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=covariance),
    )


def report_message(told: Told, stamp: int, origin: Array) -> Any | None:
    """Return the RobustReport of a vehicle, `origin` as for `estimate_message`; None: its observer has no such ones.

    Its dead reckoning is from where it began, and knows no map.
    """
    m = told.message
    if m is None or (m.position is not None and not {"odometry", "depends_on"} <= set(m.extra)):
        return None
    valid = m.position is not None and m.rotation is not None and m.covariance is not None
    pose, odometry, covariance, depends_on = _pose(np.eye(3), np.zeros(3)), _pose(np.eye(3), np.zeros(3)), np.eye(6), 0
    if m.position is not None and m.rotation is not None and m.covariance is not None:
        pose, covariance = _pose(m.rotation, m.position + origin), np.asarray(m.covariance, dtype=np.float64)
        odometry, depends_on = _pose(*from_six(m.extra["odometry"])), int(m.extra["depends_on"][0])
    return make(
        "coopenv_msgs/msg/RobustReport",
        header=header(stamp, "map"),
        valid=valid,
        pose=pose,
        covariance=covariance.ravel(),
        odometry=odometry,
        depends_on=depends_on,
    )


def _pose(R: Array, p: Array) -> Any:
    x, y, z, w = Rotation.from_matrix(np.array(R)).as_quat().tolist()
    return make(
        "geometry_msgs/msg/Pose",
        position=make("geometry_msgs/msg/Point", x=float(p[0]), y=float(p[1]), z=float(p[2])),
        orientation=make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
    )


def checked(told: Told) -> bool:
    """Return whether an estimate is one that others can read."""
    numbers = np.concatenate([told.rotation.ravel(), told.position, told.covariance.ravel()])
    return bool(np.isfinite(numbers).all())
