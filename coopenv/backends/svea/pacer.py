"""Real time: absolute deadlines, none of which is made up for once it has been missed."""

import time
from collections import deque

import numpy as np

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
