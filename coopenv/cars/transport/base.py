"""What every transport does: carry bytes by topic between processes, without looking at them."""

import re
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from coopenv.base.errors import CoopenvError


class LinkError(CoopenvError):
    """The network, or a process on it, cannot be reached."""


@dataclass(frozen=True, slots=True)
class Arrival:
    """A message that has come."""

    topic: str
    payload: bytes
    received: int  # ns, wall clock of the receiver
    attachment: bytes = b""  # what came beside it: its signature


Callback = Callable[[Arrival], None]
"""Called in a thread of the transport: it is to keep the message and return."""


class Transport(Protocol):
    """A connection to the network; used from any thread."""

    def publish(
        self, topic: str, payload: bytes, attachment: bytes = b"", *, urgent: bool = False, reliable: bool = False
    ) -> None:
        """Send a message to whoever has subscribed; what cannot be sent is lost, nothing is raised."""
        ...

    def subscribe(self, pattern: str, callback: Callback) -> None:
        """Be called for every message from now on whose topic matches; `*` stands for one part, `**` for any."""
        ...

    def announce(self, name: str) -> None:
        """Let others see that `name` is there, until this connection ends."""
        ...

    def watch(self, pattern: str, callback: Callable[[str, bool], None]) -> None:
        """Be called with (name, whether it is there) for every announced name that matches, now and later."""
        ...

    def close(self) -> None:
        """End the connection; may be called again."""
        ...


def matcher(pattern: str) -> Callable[[str], bool]:
    """Return what tells whether a topic matches: `*` stands for one part of it, `**` for any number, none included."""
    parts = ("(?:[^/]+/)*" if part == "**" else _part(part) + "/" for part in pattern.split("/"))
    expression = re.compile("".join(parts))
    return lambda topic: expression.fullmatch(f"{topic}/") is not None


def _part(part: str) -> str:
    return "[^/]+" if part == "*" else re.escape(part)


Matcher = Callable[[str], bool]


class Hub:
    """The network of one process."""

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._subscribers: list[tuple[Matcher, Callback, object]] = []
        self._watchers: list[tuple[Matcher, Callable[[str, bool], None], object]] = []
        self._present: list[tuple[str, object]] = []

    def connect(self) -> "Local":
        """Return a connection."""
        return Local(self)


class Local:
    """A connection to a hub; messages are delivered in the sender's thread."""

    def __init__(self, hub: Hub) -> None:
        self._hub = hub
        self._closed = False

    def publish(
        self, topic: str, payload: bytes, attachment: bytes = b"", *, urgent: bool = False, reliable: bool = False
    ) -> None:
        """Deliver a message."""
        arrival = Arrival(topic, payload, time.time_ns(), attachment)
        with self._hub._lock:
            called = [callback for matches, callback, _ in self._hub._subscribers if matches(topic)]
        for callback in called if not self._closed else ():
            callback(arrival)

    def subscribe(self, pattern: str, callback: Callback) -> None:
        """Subscribe, see `Transport`."""
        with self._hub._lock:
            self._hub._subscribers.append((matcher(pattern), callback, self))

    def announce(self, name: str) -> None:
        """Announce, see `Transport`."""
        with self._hub._lock:
            new = all(name != known for known, _ in self._hub._present)
            self._hub._present.append((name, self))
        if new:
            self._tell(name, True)

    def watch(self, pattern: str, callback: Callable[[str, bool], None]) -> None:
        """Watch, see `Transport`."""
        matches = matcher(pattern)
        with self._hub._lock:
            self._hub._watchers.append((matches, callback, self))
            there = {name for name, _ in self._hub._present if matches(name)}
        for name in sorted(there):
            callback(name, True)

    def close(self) -> None:
        """Leave the hub."""
        hub = self._hub
        with hub._lock:
            self._closed = True
            hub._subscribers = [entry for entry in hub._subscribers if entry[2] is not self]
            hub._watchers = [entry for entry in hub._watchers if entry[2] is not self]
            before = {name for name, _ in hub._present}
            hub._present = [entry for entry in hub._present if entry[1] is not self]
            gone = before - {name for name, _ in hub._present}
        for name in sorted(gone):
            self._tell(name, False)

    def _tell(self, name: str, there: bool) -> None:
        with self._hub._lock:
            called = [callback for matches, callback, _ in self._hub._watchers if matches(name)]
        for callback in called:
            callback(name, there)
