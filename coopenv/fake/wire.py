"""The network as a fake car has it: a transport with the faults of its link."""

import heapq
import itertools
import random
import threading
from collections.abc import Callable

from coopenv.fake.faults import Faults
from coopenv.svea.transport.base import Arrival, Callback, Transport


class Wire:
    """A transport on which messages get lost, come late, or stop, both ways; whoever holds it calls `flush`."""

    def __init__(self, transport: Transport, faults: Faults, steady: Callable[[], int], seed: int) -> None:
        """Lay it.

        Args:
            transport: what carries the messages; stays the caller's.
            faults: that it has.
            steady: the clock that they go by, ns.
            seed: of what is lost.
        """
        self._transport, self._faults, self._steady = transport, faults, steady
        self._rng, self._lock = random.Random(seed), threading.Lock()
        self._late: list[tuple[int, int, Callable[[], None]]] = []
        self._numbers = itertools.count()

    def publish(
        self, topic: str, payload: bytes, attachment: bytes = b"", *, urgent: bool = False, reliable: bool = False
    ) -> None:
        """Send, see `Transport`."""
        self._pass_on(lambda: self._transport.publish(topic, payload, attachment, urgent=urgent, reliable=reliable))

    def subscribe(self, pattern: str, callback: Callback) -> None:
        """Subscribe, see `Transport`."""

        def arrive(arrival: Arrival) -> None:
            self._pass_on(lambda: callback(arrival))

        self._transport.subscribe(pattern, arrive)

    def announce(self, name: str) -> None:
        """Announce, see `Transport`."""
        self._transport.announce(name)

    def watch(self, pattern: str, callback: Callable[[str, bool], None]) -> None:
        """Watch, see `Transport`."""
        self._transport.watch(pattern, callback)

    def close(self) -> None:
        """Forget what is under way."""
        with self._lock:
            self._late.clear()

    def flush(self) -> None:
        """Pass on what has been under way for long enough."""
        now = self._steady()
        while self._late:
            with self._lock:
                if not self._late or self._late[0][0] > now:
                    return
                _, _, act = heapq.heappop(self._late)
            act()

    def _pass_on(self, act: Callable[[], None]) -> None:
        if not self._faults:
            act()
            return
        now, faults = self._steady(), self._faults
        if faults.value("freeze", now) or self._rng.random() < faults.value("loss", now):
            return
        if delay := faults.value("delay", now):
            with self._lock:
                heapq.heappush(self._late, (now + round(delay * 1e9), next(self._numbers), act))
            return
        act()
