"""A network within one process."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from coopenv.cars.transport import Arrival, Callback, matcher

Matcher = Callable[[str], bool]


class Hub:
    """The network of one process."""

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._subscribers: list[tuple[Matcher, Callback, object]] = []
        self._watchers: list[tuple[Matcher, Callable[[str, bool], None], object]] = []
        self._present: list[tuple[str, object]] = []

    def connect(self) -> HubTransport:
        """Return a connection."""
        return HubTransport(self)


class HubTransport:
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
            self._notify(name, True)

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
            self._notify(name, False)

    def _notify(self, name: str, there: bool) -> None:
        with self._hub._lock:
            called = [callback for matches, callback, _ in self._hub._watchers if matches(name)]
        for callback in called:
            callback(name, there)
