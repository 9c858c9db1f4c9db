"""Names of the gate: its states, why it rejects messages, and the clocks that it is given."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum


class State(StrEnum):
    """Of the gate."""

    DISARMED = "disarmed"
    ARMED = "armed"
    TIMED_OUT = "timed_out"
    STOPPED = "stopped"


class Reason(StrEnum):
    """Why a message has been rejected."""

    TOO_LONG = "too_long"
    MALFORMED = "malformed"
    NOT_ARMED = "not_armed"
    SESSION = "session"
    SEQUENCE = "sequence"
    STALE = "stale"
    FUTURE = "future"
    SIGNATURE = "signature"
    NOT_FINITE = "not_finite"
    LIMITS = "limits"
    NONCE = "nonce"


class Rejected(Exception):  # noqa: N818
    """A message is not accepted."""

    def __init__(self, reason: Reason) -> None:
        super().__init__(reason)
        self.reason = reason


@dataclass(frozen=True)
class Clock:
    """What time it is."""

    wall: Callable[[], int]  # ns, that of stamps
    steady: Callable[[], int]  # ns, never set
