"""A transport within one process, for tests and for fake cars in threads."""

import re
import threading
import time
from collections.abc import Callable

from coopenv.svea.transport.base import Arrival, Callback


class Hub:
    """The network of one process."""

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._subscribers: list[tuple[re.Pattern[str], Callback, object]] = []
        self._watchers: list[tuple[re.Pattern[str], Callable[[str, bool], None], object]] = []
        self._present: dict[str, object] = {}

    def connect(self) -> "Local":
        """Return a connection."""
        return Local(self)


class Local:
    """A connection to a hub; messages are delivered in the sender's thread."""

    def __init__(self, hub: Hub) -> None:
        self._hub = hub

    def publish(
        self, topic: str, payload: bytes, attachment: bytes = b"", *, urgent: bool = False, reliable: bool = False
    ) -> None:
        """Deliver a message."""
        arrival = Arrival(topic, payload, time.time_ns(), attachment)
        with self._hub._lock:
            called = [callback for pattern, callback, _ in self._hub._subscribers if pattern.fullmatch(topic)]
        for callback in called:
            callback(arrival)

    def subscribe(self, pattern: str, callback: Callback) -> None:
        """Subscribe, see `Transport`."""
        with self._hub._lock:
            self._hub._subscribers.append((expression(pattern), callback, self))

    def announce(self, name: str) -> None:
        """Announce, see `Transport`."""
        with self._hub._lock:
            self._hub._present[name] = self
        self._tell(name, True)

    def watch(self, pattern: str, callback: Callable[[str, bool], None]) -> None:
        """Watch, see `Transport`."""
        matched = expression(pattern)
        with self._hub._lock:
            self._hub._watchers.append((matched, callback, self))
            there = [name for name in self._hub._present if matched.fullmatch(name)]
        for name in there:
            callback(name, True)

    def close(self) -> None:
        """Leave the hub."""
        hub = self._hub
        with hub._lock:
            hub._subscribers = [entry for entry in hub._subscribers if entry[2] is not self]
            hub._watchers = [entry for entry in hub._watchers if entry[2] is not self]
            gone = [name for name, owner in hub._present.items() if owner is self]
            for name in gone:
                del hub._present[name]
        for name in gone:
            self._tell(name, False)

    def _tell(self, name: str, there: bool) -> None:
        with self._hub._lock:
            called = [callback for pattern, callback, _ in self._hub._watchers if pattern.fullmatch(name)]
        for callback in called:
            callback(name, there)


def expression(pattern: str) -> re.Pattern[str]:
    """Return a key expression as a regular expression: `*` is one part of a name, `**` any number of parts."""
    parts = [".*" if part == "**" else "[^/]*".join(map(re.escape, part.split("*"))) for part in pattern.split("/")]
    return re.compile("/".join(parts).replace("/.*", "(/.*)?"))
