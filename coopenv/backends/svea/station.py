"""The end of the network that an environment is: what has come waits here until a tick takes it."""

import threading
import time
from collections import Counter, deque
from collections.abc import Collection, Iterable, Mapping

from coopenv.svea.codec import MOST_BYTES
from coopenv.svea.signing import Verifier
from coopenv.svea.transport.base import Arrival, Transport

MOST_WAITING = 256
"""Messages of one topic that wait for the next tick; older ones are dropped, so that a flood fills nothing."""


class Station:
    """Keeps messages by topic; its callbacks run in threads of the transport and only store."""

    def __init__(
        self,
        transport: Transport,
        topics: Iterable[str],
        verifier: Verifier | None,
        signers: Mapping[str, Collection[str]],
    ) -> None:
        """Subscribe.

        Args:
            transport: the network.
            topics: what to subscribe to.
            verifier: checks signatures; None: nothing is signed.
            signers: topic to who may have signed it, for those that others could forge.
        """
        self._lock = threading.Lock()
        self._waiting: dict[str, deque[Arrival]] = {topic: deque(maxlen=MOST_WAITING) for topic in topics}
        self._last: dict[str, float] = {}
        self._verifier, self._signers = verifier, signers
        self.dropped: Counter[str] = Counter()
        """Messages by why they were dropped before anybody looked at them: overflow, signature, too long."""
        for topic in self._waiting:
            transport.subscribe(topic, self._keep)

    def _keep(self, arrival: Arrival) -> None:
        waiting = self._waiting.get(arrival.topic)
        if waiting is None:
            return
        if len(arrival.payload) > MOST_BYTES:
            self._drop("too long")
            return
        if not self._is_genuine(arrival):
            self._drop("signature")
            return
        with self._lock:
            if len(waiting) == MOST_WAITING:
                self.dropped["overflow"] += 1
            waiting.append(arrival)
            self._last[arrival.topic] = time.monotonic()

    def _drop(self, why: str) -> None:
        with self._lock:
            self.dropped[why] += 1

    def _is_genuine(self, arrival: Arrival) -> bool:
        expected = self._signers.get(arrival.topic)
        if self._verifier is None or expected is None:
            return True
        return self._verifier.signer(arrival.topic, arrival.payload, arrival.attachment) in expected

    def drain(self) -> list[Arrival]:
        """Return what has come since the last call, in the order in which it was received."""
        with self._lock:
            taken = [arrival for waiting in self._waiting.values() for arrival in waiting]
            for waiting in self._waiting.values():
                waiting.clear()
        return sorted(taken, key=lambda arrival: (arrival.received, arrival.topic))

    def silence(self, topic: str) -> float:
        """Return for how long nothing has come on a topic, s; inf: never anything."""
        with self._lock:
            last = self._last.get(topic)
        return float("inf") if last is None else time.monotonic() - last
