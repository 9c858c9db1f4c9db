"""Who is there, on networks that do not know it themselves: whoever announces itself says so again and again."""

import threading
import time
import uuid
from collections.abc import Callable

from coopenv.svea.transport.patterns import matcher

PERIOD = 0.25  # s between two times
LEASE = 1.0  # s of silence after which somebody counts as gone

Change = Callable[[str, bool], None]


class Presence:
    """Names that this end announces, and those of others that it has heard."""

    def __init__(self, say: Callable[[str, bytes], None]) -> None:
        """Take what sends a heartbeat: (name, payload)."""
        self._say = say
        self._self = uuid.uuid4().bytes  # two ends may announce one name, of which one goes
        self._own: list[str] = []
        self._last: dict[tuple[str, bytes], float] = {}
        self._watchers: list[tuple[Callable[[str], bool], Change]] = []
        self._lock = threading.RLock()

    def announce(self, name: str) -> None:
        """Begin to say that `name` is there."""
        with self._lock:
            self._own.append(name)
        self._say(name, b"+" + self._self)

    def watch(self, pattern: str, callback: Change) -> None:
        """Call back for every name that matches, now and when it comes or goes."""
        matches = matcher(pattern)
        with self._lock:
            self._watchers.append((matches, callback))
            for name in sorted({name for name, _ in self._last if matches(name)}):
                callback(name, True)

    def hear(self, name: str, payload: bytes) -> None:
        """Take a heartbeat."""
        who = name, payload[1:]
        with self._lock:
            if payload[:1] == b"+":
                new = all(known != name for known, _ in self._last)
                self._last[who] = time.monotonic()
                if new:
                    self._tell(name, True)
            elif self._last.pop(who, None) is not None:
                self._tell_if_gone(name)

    def beat(self) -> None:
        """Say what is to be said and see who has fallen silent; to be called every `PERIOD`."""
        with self._lock:
            own, late = list(self._own), time.monotonic() - LEASE
            for who in [who for who, last in self._last.items() if last < late]:
                del self._last[who]
                self._tell_if_gone(who[0])
        for name in own:
            self._say(name, b"+" + self._self)

    def leave(self) -> None:
        """Say that this end goes."""
        with self._lock:
            own, self._own = self._own, []
            self._watchers.clear()
        for name in own:
            self._say(name, b"-" + self._self)

    def _tell_if_gone(self, name: str) -> None:
        if all(known != name for known, _ in self._last):
            self._tell(name, False)

    def _tell(self, name: str, there: bool) -> None:
        for matches, callback in self._watchers:
            if matches(name):
                callback(name, there)
