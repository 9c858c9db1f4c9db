"""What `robust` sends, as other programs see it: 196 bytes."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.linalg.lapack import dpotrf

from coopenv.errors import CoopenvError
from coopenv.estimation.rotations import exp_so3, log_so3
from coopenv.observers.checks import check_estimate
from coopenv.observers.contract import Estimate, Message
from coopenv.scenario.base import LARGEST
from coopenv.world.embedded import Messages

LEAST_VARIANCE = 1e-14
"""rad^2 and m^2: nobody knows a pose to 0.1 um."""


def write(observer: Any) -> Message:
    """Return pose, covariance (single precision), dead reckoning and a mask, or nothing while the pose is not known."""
    m = observer.memory
    if not m.outbox_says[0]:
        return Message()
    odometry = np.concatenate([log_so3(m.outbox_odometry_rotation[0]), m.outbox_odometry_position[0]])
    return Message(
        position=m.outbox_position[0].copy(),
        rotation=m.outbox_rotation[0].copy(),
        covariance=m.outbox_covariance[0].copy(),
        extra={"odometry": odometry, "leans_on": m.outbox_leans_on[:1].copy()},
    )


def read(observer: Any, sender: int, message: Message, sent: int) -> None:
    """Put a message into the inbox.

    Raises:
        CoopenvError: it is malformed.
        LookupError: likewise.
    """
    m = observer.memory
    m.inbox_tick[sender], m.inbox_says[sender] = sent, 0
    if message.position is None and not message.extra:  # the sender does not know where it is
        return
    check_pose(message)
    odometry, leans_on = (np.asarray(message.extra[name]) for name in ("odometry", "leans_on"))
    if odometry.shape != (6,) or not (np.abs(odometry) <= LARGEST).all():
        raise CoopenvError("message: odometry")
    if leans_on.shape != (1,) or leans_on.dtype != np.uint64:
        raise CoopenvError("message: leans_on")
    m.inbox_rotation[sender], m.inbox_position[sender] = message.rotation, message.position
    m.inbox_covariance[sender] = message.covariance
    m.inbox_odometry_rotation[sender], m.inbox_odometry_position[sender] = exp_so3(odometry[:3]), odometry[3:]
    m.inbox_leans_on[sender] = leans_on[0]
    m.inbox_says[sender] = 1


def check_pose(message: Message) -> None:
    """Refuse what is no pose with a covariance that can be inverted.

    Raises:
        CoopenvError: it is not.
    """
    if message.position is None or message.rotation is None or message.covariance is None:
        raise CoopenvError("message: no pose with a covariance")
    P = np.asarray(message.covariance, dtype=np.float64)
    check_estimate(Estimate(message.rotation, message.position, P))
    if dpotrf(P)[1] != 0 or P.diagonal().min() < LEAST_VARIANCE or not (np.abs(message.position) <= LARGEST).all():
        raise CoopenvError("message: covariance or position")


MESSAGES = Messages(write, read)
