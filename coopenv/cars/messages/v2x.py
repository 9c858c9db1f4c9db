"""V2X messages between cars: those that a station sends, and what an observer gets of a received pose."""

from typing import Any

import numpy as np

from coopenv.cars.messages.codec import header, make, pose
from coopenv.cars.messages.readings import CarPose
from coopenv.estimation.poses import Array, Coordinates, covariance_in_map, skew
from coopenv.observers.contract import Message
from coopenv.observers.robust.messages import from_six
from coopenv.sources.base import VehicleBroadcast


def arm_of(pose: CarPose, marker: Array) -> Array:
    """Return the vector (3,) in the map from a body to its marker, which is at `marker` (3,) in the body frame, m.

    A position without an orientation gives the marker's height alone.
    """
    arm: Array = np.array([0.0, 0.0, marker[2]]) if pose.rotation is None else pose.rotation @ marker
    return arm


def message_of(pose: CarPose, marker: Array) -> Message:
    """Return the message of a sender for an observer; `marker` as for `arm_of`."""
    arm, covariance = arm_of(pose, marker), None
    if pose.covariance is not None:
        J = np.hstack([np.eye(3), -skew(arm)])  # of the marker's place by those of position and rotation
        covariance = J @ pose.covariance @ J.T
    return Message(pose.position + arm, pose.rotation, covariance)


def estimate_message(sent: VehicleBroadcast, stamp: int, origin: Array) -> Any:
    """Return the PoseWithCovarianceStamped of an estimate; rotations of its covariance are about the map's axes.

    `origin` (3,) is that of the map in the coordinates of the scenario's file, which are those on the wire.
    """
    covariance = covariance_in_map(Coordinates.RICCATI, sent.rotation, sent.position, sent.covariance)
    placed = {"pose": pose(sent.rotation, sent.position + origin), "covariance": covariance}
    return make("geometry_msgs/msg/PoseWithCovarianceStamped", header=header(stamp, "map"), pose=placed)


def report_message(sent: VehicleBroadcast, stamp: int, origin: Array) -> Any | None:
    """Return the RobustReport of a vehicle, `origin` as for `estimate_message`; None: its observer has no such report.

    Its dead reckoning starts at the identity, in no map frame.
    """
    m = sent.message
    if m is None or (m.position is not None and not {"odometry", "depends_on"} <= set(m.extra)):
        return None
    if m.position is None or m.rotation is None or m.covariance is None:
        unknown = pose(np.eye(3), np.zeros(3))
        fields = {"pose": unknown, "covariance": np.eye(6), "odometry": unknown}
    else:
        placed, odometry = pose(m.rotation, m.position + origin), pose(*from_six(m.extra["odometry"]))
        fields = {"valid": True, "pose": placed, "covariance": m.covariance, "odometry": odometry}
        fields["depends_on"] = int(m.extra["depends_on"][0])
    return make("coopenv_msgs/msg/RobustReport", header=header(stamp, "map"), **fields)
