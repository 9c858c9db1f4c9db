"""Camera frames of one car that wait to be used: one a tick, in the order of their exposure."""

from collections import deque

from coopenv.svea.samples import Detections

MOST_WAITING = 2
"""Frames that may wait after a tick has taken one: clocks of cameras and ticks drift past each other, so that now and
then two come within a tick. More mean that the computer lags behind, and the oldest are left out."""


class Frames:
    """The queue of one car; times in ns on one clock."""

    def __init__(self) -> None:
        self._waiting: deque[tuple[int, Detections]] = deque()
        self._newest = -1
        self.disordered = 0
        """Frames that were older than one before."""
        self.skipped = 0
        """Frames that were left out because too many waited."""

    def put(self, stamp: int, frame: Detections) -> None:
        """Take a frame."""
        if stamp <= self._newest:
            self.disordered += 1
            return
        self._newest = stamp
        self._waiting.append((stamp, frame))
        while len(self._waiting) > MOST_WAITING + 1:
            self._waiting.popleft()
            self.skipped += 1

    def take(self, after: int, until: int) -> tuple[int, Detections] | None:
        """Return the oldest frame exposed after a time and by another one; None: there is none."""
        while self._waiting and self._waiting[0][0] <= after:
            self._waiting.popleft()
            self.disordered += 1
        if not self._waiting or self._waiting[0][0] > until:
            return None
        return self._waiting.popleft()
