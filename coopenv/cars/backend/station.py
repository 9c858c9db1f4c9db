"""The end of the network that an environment is: what has come waits here until a tick takes it."""

import threading
import time
from collections import Counter, deque
from collections.abc import Collection, Iterable, Mapping

import numpy as np

from coopenv.cars.codec import MOST_BYTES
from coopenv.cars.keys import Verifier
from coopenv.cars.transport.base import Arrival, Transport

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


KEPT = 100_000  # lateness of so many ticks is kept for the statistics


class Pacer:
    """Ticks of a fixed period; times are in ns of a clock that never jumps, set by the wall clock at the start.

    A decision has as long as it lasts: its first ticks may come late where the one before took long, its last one is
    on time again. Where it has not even begun by the time of its last tick, it has missed its deadline: that time is
    left out, and the next decisions follow at whole decisions after it.
    """

    def __init__(self, period: float, per_decision: int) -> None:
        """Give the period of ticks in s, and how many make a decision."""
        self._period = round(period * 1e9)
        self._decision = self._period * per_decision
        self._wall = time.time_ns() - time.monotonic_ns()
        self._due = 0
        self._begun = False
        self.missed = 0
        """Decisions that missed their deadline."""
        self.in_a_row = 0
        self.lateness: deque[float] = deque(maxlen=KEPT)
        """s by which ticks were given after their time."""

    def now(self) -> int:
        """Return the time."""
        return time.monotonic_ns() + self._wall

    def start(self) -> int:
        """Begin anew: time counts from the first decision on. Returns the time now."""
        self._wall = time.time_ns() - time.monotonic_ns()
        self.missed = self.in_a_row = 0
        self.lateness.clear()
        self._begun = False
        return self.now()

    def decide(self) -> None:
        """Begin a decision: where even its last tick is due already, count it and go on from now."""
        if not self._begun:
            self._begun, self._due = True, self.now()
        self.in_a_row = self.in_a_row + 1 if self._leave_out() else 0

    def wait(self) -> int:
        """Sleep until the next tick is due and return the time then."""
        self._leave_out()  # where the computer stood still within a decision
        self._due += self._period
        left = self._due - self.now()
        if left > 0:
            time.sleep(left * 1e-9)
        now = self.now()
        self.lateness.append((now - self._due) * 1e-9)
        return now

    def _leave_out(self) -> bool:
        """Leave out the decisions whose time is over, and say whether there were any."""
        over = (self.now() - self._due) // self._decision
        if over <= 0:
            return False
        self.missed += 1
        self._due += over * self._decision
        return True

    def late(self, share: float) -> float:
        """Return the lateness that a share of the ticks did not exceed, s; 0 where there were none."""
        return float(np.quantile(self.lateness, share)) if self.lateness else 0.0
