"""Messages that wait to be sent by the thread of a transport: so many at most, the urgent ones first."""

import threading
from collections import deque
from typing import NamedTuple


class Letter(NamedTuple):
    """A message that waits."""

    topic: str
    payload: bytes
    attachment: bytes


class Outbox:
    """Two queues; used from any thread."""

    def __init__(self, most: int, patience: float) -> None:
        """Make it.

        Args:
            most: messages of each queue; then the oldest is dropped.
            patience: s that the sender of a reliable message waits before that.
        """
        self._most, self._patience = most, patience
        self._urgent: deque[Letter] = deque()
        self._other: deque[Letter] = deque()
        self._changed = threading.Condition()

    def put(self, letter: Letter, *, urgent: bool, patient: bool) -> None:
        """Add a message; if there is no room, a patient sender waits for some, and then the oldest goes."""
        queue = self._urgent if urgent else self._other
        with self._changed:
            if patient:
                self._changed.wait_for(lambda: len(queue) < self._most, self._patience)
            if len(queue) >= self._most:
                queue.popleft()
            queue.append(letter)

    def take(self) -> Letter | None:
        """Return the next message; None: there is none."""
        with self._changed:
            queue = self._urgent or self._other
            if not queue:
                return None
            self._changed.notify_all()
            return queue.popleft()
