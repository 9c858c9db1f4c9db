"""Robots that lie."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from coopenv.observers.contract import Message


class Drifting:
    """Some robots broadcast places that are off and, if asked, drift on, and are sure of them to a centimetre."""

    def __init__(self, who: Sequence[int], jump: float, drift: float, since: float = 15.0) -> None:
        """Take the lying senders, counted from 0, m, m/s, and from when on, s."""
        self.who, self.jump, self.drift, self.since = who, jump, drift, since

    def __call__(self, vehicle: int, time: float, observer: Any, message: Message) -> Message:
        """Return what is broadcast instead; what it tells of whom it saw agrees with it."""
        if vehicle not in self.who or time < self.since or message.position is None:
            return message
        off = (self.jump + self.drift * (time - self.since)) * np.array([0.6, 0.8, 0.0])
        lie = replace(message, position=message.position + off, covariance=1e-4 * np.eye(3))
        return observer.tampered(lie, message)  # type: ignore[no-any-return]


class Replaying:
    """Some robots broadcast what they sent some messages ago, from 15 s on."""

    def __init__(self, who: Sequence[int], messages: int) -> None:
        self.who, self.messages = who, messages
        self._sent: dict[int, list[Message]] = {}

    def __call__(self, vehicle: int, time: float, observer: Any, message: Message) -> Message:
        """Return what is broadcast instead."""
        if vehicle not in self.who or time < 15.0:
            return message
        sent = self._sent.setdefault(vehicle, [])
        sent.append(message)
        return sent[max(len(sent) - 1 - self.messages, 0)]
