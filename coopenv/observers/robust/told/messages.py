"""What `robust` sends, as other programs see it: 248 bytes with two correlations."""

from dataclasses import replace
from typing import Any

import numpy as np

from coopenv.errors import CoopenvError
from coopenv.observers.contract import Message
from coopenv.observers.robust.constants import MAX_CORRELATIONS, STEPS
from coopenv.observers.robust.messages import read, write
from coopenv.world.embedded import Messages


def write_told(observer: Any) -> Message:
    """Return pose, covariance and dead reckoning (single precision), and correlations in whole steps."""
    message = write(observer)
    if message.position is None:
        return message
    told = observer.memory.outbox_correlation[0]
    told = told[told["vehicle"] >= 0]
    extra = {
        "odometry": message.extra["odometry"].astype(np.float32),
        "told": told["vehicle"].astype(np.uint16),
        "correlations": told["matrix"].astype(np.int8),
    }
    return replace(message, extra={**message.extra, **extra})


def read_told(observer: Any, sender: int, message: Message, sent: int) -> None:
    """Put a message into the inbox; a CoopenvError or LookupError says that it is malformed."""
    m = observer.memory
    read(observer, sender, message, sent)
    kept = m.correlation[sender]
    kept["vehicle"] = -1
    if not m.inbox[sender]["valid"]:
        return
    m.inbox[sender]["valid"] = 0
    told, matrices = (np.asarray(message.extra[name]) for name in ("told", "correlations"))
    count = len(observer.setup.target_names) - observer.setup.landmarks
    if told.ndim != 1 or len(told) > MAX_CORRELATIONS or told.dtype.kind != "u" or not (told < count).all():
        raise CoopenvError("message: told")
    if len(np.unique(told)) < len(told) or sender in told:
        raise CoopenvError("message: told twice")
    if matrices.shape != (len(told), 6, 6) or matrices.dtype != np.int8 or (matrices < -STEPS).any():
        raise CoopenvError("message: correlations")
    m.inbox[sender]["valid"] = 1
    kept["vehicle"][: len(told)], kept["matrix"][: len(told)] = told, matrices


TOLD_MESSAGES = Messages(write_told, read_told)
