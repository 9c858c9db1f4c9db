"""What the wheels of a fake car follow: commands after their dead time, and neutral where none come."""

from collections import deque
from collections.abc import Iterator

from coopenv.svea.actuation import NEUTRAL, Drive

TIMEOUT = 500_000_000  # ns without a command after which the flight controller (PX4) goes to neutral


class Actuators:
    """Commands in the order of time; times in ns on one clock. Lag, limits and dead band are the room's."""

    def __init__(self, latency: float) -> None:
        """Build them for a dead time in s."""
        self._latency = round(latency * 1e9)
        self._waiting: deque[tuple[int, Drive]] = deque()  # from when on
        self._now = NEUTRAL
        self._until = 0  # when the command that is followed becomes too old

    def clear(self) -> None:
        """Forget all commands."""
        self._waiting.clear()
        self._now = NEUTRAL

    def receive(self, drive: Drive, at: int) -> None:
        """Take a command that has come."""
        self._waiting.append((at + self._latency, drive))

    def pieces(self, begin: int, end: int) -> Iterator[tuple[float, Drive]]:
        """Yield (how long in s, what is followed) from a time to a later one; each stretch is asked for once."""
        now = begin
        while now < end:
            if self._waiting and self._waiting[0][0] <= now:
                since, self._now = self._waiting.popleft()
                self._until = since + TIMEOUT
                continue
            if self._now != NEUTRAL and now >= self._until:
                self._now = NEUTRAL
            stop = min(end, self._waiting[0][0] if self._waiting else end)
            if self._now != NEUTRAL:
                stop = min(stop, self._until)
            yield (stop - now) * 1e-9, self._now
            now = stop
