"""When sensors measure: each at its own rate, with a phase of its own and jitter, by absolute times."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

JITTER = 0.05  # of a period, largest deviation to either side of a regular time
LATE = 50_000_000
"""ns: measurements that are overdue for longer than this are left out, as after a computer that stood still."""


@dataclass
class _Timer:
    period: float  # ns
    regular: float  # ns, the next time without jitter
    due: int  # ns, with it


class Schedule:
    """Times of several sensors; in ns on one clock."""

    def __init__(self, rates: Mapping[str, float], start: int, rng: np.random.Generator) -> None:
        """Begin.

        Args:
            rates: Hz by name.
            start: from when on.
            rng: of phases and jitter.
        """
        self._rng, self._timers = rng, {}
        for name, rate in rates.items():
            period = 1e9 / rate
            timer = _Timer(period, start + period * rng.uniform(0.1, 1.0), 0)
            self._timers[name] = timer
            self._draw(timer)

    @property
    def next(self) -> int:
        """When something is due next."""
        return min([timer.due for timer in self._timers.values()])

    def until(self, now: int) -> Iterator[tuple[int, str]]:
        """Yield (when, name) of all that is due up to now, in the order of time."""
        while (due := self.next) <= now:
            name, timer = next((name, timer) for name, timer in self._timers.items() if timer.due == due)
            timer.regular += timer.period
            self._draw(timer)
            if due >= now - LATE:
                yield due, name

    def _draw(self, timer: _Timer) -> None:
        timer.due = int(timer.regular + timer.period * JITTER * self._rng.uniform(-1.0, 1.0))
