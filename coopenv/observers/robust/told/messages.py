"""What `robust` sends, as other programs see it: 172 bytes, at times 256 with two correlations."""

from dataclasses import replace
from typing import Any

import numpy as np

from coopenv.base.errors import CoopenvError
from coopenv.observers.contract import Message
from coopenv.observers.robust.constants import MAX_CORRELATIONS, STEPS
from coopenv.observers.robust.messages import read, write
from coopenv.scenario.base import LARGEST
from coopenv.world.embedded import Messages


def write_told(observer: Any) -> Message:
    """Return pose, covariance and dead reckoning (single precision), at times also correlations in whole steps."""
    message = write(observer)
    if message.position is None:
        return message
    extra: dict[str, Any] = {**message.extra, "odometry": message.extra["odometry"].astype(np.float32)}
    report = observer.memory.outbox[0]
    if report["news"]:
        told = observer.memory.outbox_correlation[0]
        told = told[told["vehicle"] >= 0]
        ages = (int(report["tick"]) - told["tick"]) * observer.unit
        extra |= {
            "told": told["vehicle"].astype(np.uint16),
            "ages": ages.astype(np.float32),
            "correlations": told["matrix"].astype(np.int8),
        }
    return replace(message, extra=extra)


def read_told(observer: Any, sender: int, message: Message, sent: int) -> None:
    """Put a message into the inbox; a CoopenvError or LookupError says that it is malformed."""
    m = observer.memory
    read(observer, sender, message, sent)
    m.inbox[sender]["news"] = 0
    if not m.inbox[sender]["valid"] or "told" not in message.extra:
        return
    m.inbox[sender]["valid"] = 0
    told, ages, matrices = (np.asarray(message.extra[name]) for name in ("told", "ages", "correlations"))
    count = len(observer.setup.target_names) - observer.setup.landmarks
    if told.ndim != 1 or len(told) > MAX_CORRELATIONS or told.dtype.kind != "u" or not (told < count).all():
        raise CoopenvError("message: told")
    if len(np.unique(told)) < len(told) or sender in told:
        raise CoopenvError("message: told twice")
    if matrices.shape != (len(told), 6, 6) or matrices.dtype != np.int8 or (matrices < -STEPS).any():
        raise CoopenvError("message: correlations")
    if ages.shape != told.shape or not ((ages >= 0.0) & (ages <= LARGEST)).all():
        raise CoopenvError("message: ages")
    m.inbox[sender]["valid"] = m.inbox[sender]["news"] = 1
    kept = m.correlation[sender]
    kept["vehicle"] = -1
    for n, (vehicle, age, matrix) in enumerate(zip(told.tolist(), ages.tolist(), matrices, strict=True)):
        kept[n] = vehicle, sent - observer.units(age), matrix


TOLD_MESSAGES = Messages(write_told, read_told)
