"""What `robust_joint` sends, as other programs see it: 281 bytes alone, 1715 with three others."""

from dataclasses import replace
from typing import Any

import numpy as np

from coopenv.base.errors import CoopenvError
from coopenv.observers.contract import Message
from coopenv.observers.robust.constants import MAX_TOLD, MIN_VARIANCE
from coopenv.observers.robust.messages import from_six, read, six_of, write
from coopenv.scenario.base import LARGEST
from coopenv.world.embedded import Messages

JOINT = ("vehicles", "ages", "poses", "odometries", "factor", "complete")  # what a joint message has besides


def write_joint(observer: Any) -> Message:
    """Return a message that also tells of other vehicles: poses, odometry, and the factor of the joint covariance.

    The factor, in single precision, keeps what a covariance would lose.
    """
    message = write(observer)
    if message.position is None:
        return message
    m = observer.memory
    others = int(m.outbox_joint[0]["others"])
    told = m.outbox_told[0, :others]
    n = 6 * (others + 1)
    joint: dict[str, Any] = {
        "vehicles": told["vehicle"].astype(np.uint16),
        "ages": (int(m.outbox[0]["tick"]) - told["tick"]) * observer.unit,
        "poses": _six(told["pose"]),
        "odometries": _six(told["odometry"]),
        "factor": m.outbox_factor[0, : n * (n + 1) // 2].copy(),
        "complete": m.outbox_joint[0]["complete"].astype(np.uint8).reshape(1),
    }
    return replace(message, extra={**message.extra, **joint})


def read_joint(observer: Any, sender: int, message: Message, sent: int) -> None:
    """Put a message that also tells of other vehicles into the inbox; errors are those of `read`."""
    m, extra = observer.memory, message.extra
    read(observer, sender, message, sent)
    if not m.inbox[sender]["valid"]:
        return
    m.inbox[sender]["valid"] = 0
    vehicles, ages, poses, odometries, factor, complete = (np.asarray(extra[name]) for name in JOINT)
    others = len(vehicles)
    n = 6 * (others + 1)
    names = {sender, *vehicles.tolist()}
    if (
        vehicles.dtype.kind not in "iu"
        or others >= MAX_TOLD
        or len(names) <= others
        or not _are_vehicles(observer, names)
    ):
        raise CoopenvError("message: vehicles")
    for name, value, shape in (
        ("ages", ages, (others,)),
        ("poses", poses, (others, 6)),
        ("odometries", odometries, (others, 6)),
    ):
        if value.shape != shape or not (np.abs(value) <= LARGEST).all():
            raise CoopenvError(f"message: {name}")
    if factor.shape != (n * (n + 1) // 2,) or not (np.abs(factor) <= LARGEST).all() or complete.shape != (1,):
        raise CoopenvError("message: factor")
    if not (factor[np.cumsum(np.arange(1, n + 1)) - 1] ** 2 >= MIN_VARIANCE).all():
        raise CoopenvError("message: factor is singular")
    told = m.inbox_told[sender, :others]
    told["vehicle"], told["tick"] = vehicles, [sent - observer.units(age) for age in ages.tolist()]
    for one, pose, odometry in zip(told, poses, odometries, strict=True):
        one["pose"], one["odometry"] = from_six(pose), from_six(odometry)
    m.inbox_factor[sender, : len(factor)] = factor
    m.inbox_joint[sender] = others, complete[0] != 0
    m.inbox[sender]["valid"] = 1


def tampered(message: Message) -> Message:
    """Return a message whose joint covariance claims what its own does, for studies of liars."""
    if message.covariance is None or "factor" not in message.extra:
        return message
    n = 6 * (1 + len(message.extra["vehicles"]))
    L = np.zeros((n, n))
    L[np.tril_indices(n)] = message.extra["factor"]
    P = L @ L.T
    if np.allclose(P[:6, :6], message.covariance, rtol=1e-3, atol=1e-3 * np.diag(message.covariance).min()):
        return message  # it claims what it believes
    P[:6, 6:], P[6:, :6], P[:6, :6] = 0.0, 0.0, message.covariance
    factor = np.linalg.cholesky(P)[np.tril_indices(n)].astype(np.float32)
    more: dict[str, Any] = {**message.extra, "factor": factor}
    return replace(message, extra=more)


def _six(poses: Any) -> Any:
    """Return poses as rotation vectors and positions (m, 6)."""
    return np.array([six_of(pose) for pose in poses]).reshape(-1, 6)


def _are_vehicles(observer: Any, numbers: set[int]) -> bool:
    """Return whether all numbers are those of vehicles."""
    return min(numbers) >= 0 and max(numbers) < len(observer.setup.target_names) - observer.setup.landmarks


JOINT_MESSAGES = Messages(write_joint, read_joint, tampered)
