"""Messages of `robust` between the kernels and other programs: 172 bytes, with correlations 256."""

from dataclasses import replace
from typing import Any

import numpy as np

from coopenv.base.errors import CoopenvError
from coopenv.base.format import LARGEST
from coopenv.estimation.poses import Array, exp_so3, log_so3
from coopenv.observers.contract import Estimate, Message, check_estimate, is_definite
from coopenv.observers.robust.constants import MAX_CORRELATIONS, MIN_VARIANCE, STEPS
from coopenv.world.embedded import Messages


def write(observer: Any) -> Message:
    """Return pose, covariance, dead reckoning (single precision) and a mask; at times correlations in whole steps, too.

    While the pose is not known, the message is empty.
    """
    report = observer.memory.outbox[0]
    if not report["valid"]:
        return Message()
    extra = {"odometry": six_of(report["odometry"]).astype(np.float32), "depends_on": np.array([report["depends_on"]])}
    if report["carries_correlations"]:
        broadcast = observer.memory.outbox_correlation[0]
        broadcast = broadcast[broadcast["vehicle"] >= 0]
        ages = (int(report["tick"]) - broadcast["tick"]) * observer.unit
        extra |= {
            "correlated_vehicles": broadcast["vehicle"].astype(np.uint16),
            "ages": ages.astype(np.float32),
            "correlations": broadcast["matrix"].astype(np.int8),
        }
    return Message(report["pose"]["p"].copy(), report["pose"]["R"].copy(), report["P"].copy(), extra)


def six_of(pose: Any) -> Array:
    """Return a pose as rotation vector and position (6,)."""
    return np.concatenate([log_so3(pose["R"]), pose["p"]])


def from_six(values: Array) -> tuple[Array, Array]:
    """Return the rotation and position of a pose (6,)."""
    return exp_so3(values[:3]), values[3:]


def read(observer: Any, sender: int, message: Message, sent: int) -> None:
    """Put a message into the inbox; a CoopenvError or LookupError means that it is malformed."""
    report = observer.memory.inbox[sender]
    report["tick"], report["valid"], report["carries_correlations"] = sent, 0, 0
    if message.position is None and not message.extra:  # the sender is searching for its pose
        return
    check_pose(message)
    odometry, depends_on = _numbers(message, "odometry", (6,)), np.asarray(message.extra["depends_on"])
    if depends_on.shape != (1,) or depends_on.dtype != np.uint64:
        raise CoopenvError("message: depends_on")
    if "correlated_vehicles" in message.extra:
        _read_correlations(observer, sender, message, sent)
        report["carries_correlations"] = 1
    report["pose"], report["P"] = (message.rotation, message.position), message.covariance
    report["odometry"], report["depends_on"], report["valid"] = from_six(odometry), depends_on[0], 1


def _numbers(message: Message, name: str, shape: tuple[int, ...]) -> Array:
    """Return an entry of a message; a CoopenvError means another shape, or a number that is too large or none."""
    values = np.asarray(message.extra[name], np.float64)
    if values.shape != shape or not (np.abs(values) <= LARGEST).all():
        raise CoopenvError(f"message: {name}")
    return values


def _vehicles(observer: Any, sender: int, message: Message, name: str, most: int) -> Array:
    """Return an entry of a message that lists vehicles; a CoopenvError means that it cannot.

    These are at most so many vehicles, different from each other and from the sender.
    """
    listed = np.asarray(message.extra[name])
    count = len(observer.setup.target_names) - observer.setup.landmarks
    if listed.ndim != 1 or listed.dtype.kind not in "iu" or len(listed) > most:
        raise CoopenvError(f"message: {name}")
    vehicles = {sender, *listed.tolist()}
    if len(vehicles) <= len(listed) or not vehicles <= set(range(count)):
        raise CoopenvError(f"message: {name}")
    return listed


def lead_along(made: Message, honest: Message) -> Message:
    """Return a false message whose odometry leads where its pose does, as the honest message's leads to that one's."""
    if made.position is None or "odometry" not in honest.extra:
        return made
    R, p = from_six(np.asarray(honest.extra["odometry"], np.float64))
    back = R @ np.asarray(honest.rotation).T
    led = np.concatenate([log_so3(back @ made.rotation), p + back @ (made.position - honest.position)])
    return replace(made, extra={**made.extra, "odometry": led.astype(honest.extra["odometry"].dtype)})


def check_pose(message: Message) -> None:
    """Refuse a message without a valid pose and a covariance that can be inverted."""
    if message.position is None or message.rotation is None or message.covariance is None:
        raise CoopenvError("message: no pose with a covariance")
    P = np.asarray(message.covariance, dtype=np.float64)
    check_estimate(Estimate(message.rotation, message.position, P))
    if not is_definite(P, MIN_VARIANCE, LARGEST**2):
        raise CoopenvError("message: covariance is not positive definite, or not plausible")


def _read_correlations(observer: Any, sender: int, message: Message, sent: int) -> None:
    """Store the correlations of a message; a CoopenvError or LookupError means that they are malformed."""
    broadcast = _vehicles(observer, sender, message, "correlated_vehicles", MAX_CORRELATIONS)
    ages, matrices = np.asarray(message.extra["ages"]), np.asarray(message.extra["correlations"])
    if matrices.shape != (len(broadcast), 6, 6) or matrices.dtype != np.int8 or (matrices < -STEPS).any():
        raise CoopenvError("message: correlations")
    if ages.shape != broadcast.shape or not ((ages >= 0.0) & (ages <= LARGEST)).all():
        raise CoopenvError("message: ages")
    kept = observer.memory.correlation[sender]
    kept["vehicle"] = -1
    for n, (vehicle, age, matrix) in enumerate(zip(broadcast.tolist(), ages.tolist(), matrices, strict=True)):
        kept[n] = vehicle, sent - observer.units(age), matrix


ROBUST_MESSAGES = Messages(write, read, lead_along)
