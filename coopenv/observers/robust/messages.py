"""What `robust` and `robust_joint` both send, as other programs see it: 196 bytes."""

from typing import Any

import numpy as np

from coopenv.base.errors import CoopenvError
from coopenv.estimation.arrays import Array
from coopenv.estimation.rotations import exp_so3, log_so3
from coopenv.observers.contract import Estimate, Message, check_estimate, is_definite
from coopenv.observers.robust.constants import MIN_VARIANCE
from coopenv.scenario.base import LARGEST


def write(observer: Any) -> Message:
    """Return pose, covariance (single precision), dead reckoning and a mask, or nothing while the pose is not known."""
    report = observer.memory.outbox[0]
    if not report["valid"]:
        return Message()
    extra = {"odometry": six_of(report["odometry"]), "depends_on": np.array([report["depends_on"]])}
    return Message(report["pose"]["p"].copy(), report["pose"]["R"].copy(), report["P"].copy(), extra)


def six_of(pose: Any) -> Array:
    """Return a pose as rotation vector and position (6,)."""
    return np.concatenate([log_so3(pose["R"]), pose["p"]])


def from_six(values: Array) -> tuple[Array, Array]:
    """Return the rotation and position of a pose (6,)."""
    return exp_so3(values[:3]), values[3:]


def read(observer: Any, sender: int, message: Message, sent: int) -> None:
    """Put a message into the inbox; a CoopenvError or LookupError says that it is malformed."""
    report = observer.memory.inbox[sender]
    report["tick"], report["valid"] = sent, 0
    if message.position is None and not message.extra:  # the sender does not know where it is
        return
    check_pose(message)
    odometry, depends_on = np.asarray(message.extra["odometry"], np.float64), np.asarray(message.extra["depends_on"])
    if odometry.shape != (6,) or not (np.abs(odometry) <= LARGEST).all():
        raise CoopenvError("message: odometry")
    if depends_on.shape != (1,) or depends_on.dtype != np.uint64:
        raise CoopenvError("message: depends_on")
    report["pose"], report["P"] = (message.rotation, message.position), message.covariance
    report["odometry"], report["depends_on"], report["valid"] = from_six(odometry), depends_on[0], 1


def check_pose(message: Message) -> None:
    """Refuse a message without a valid pose and a covariance that can be inverted."""
    if message.position is None or message.rotation is None or message.covariance is None:
        raise CoopenvError("message: no pose with a covariance")
    P = np.asarray(message.covariance, dtype=np.float64)
    check_estimate(Estimate(message.rotation, message.position, P))
    if not is_definite(P, MIN_VARIANCE, LARGEST**2):
        raise CoopenvError("message: covariance is not positive definite, or not plausible")
