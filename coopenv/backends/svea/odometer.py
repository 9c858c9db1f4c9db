"""Odometry of one car: samples of its body twist, each held until the next, integrated from any time to any later."""

from collections import deque

import numpy as np

from coopenv.estimation.arrays import Array
from coopenv.estimation.rotations import rigid_exp
from coopenv.svea.samples import Twist

MOST_SAMPLES = 512
"""Of which the car has been told no time yet: five seconds of an IMU."""


class Odometer:
    """Held twists of one car; times in ns on one clock."""

    def __init__(self) -> None:
        self._samples: deque[tuple[int, Array, Array]] = deque()  # since when, v m/s, omega rad/s
        self._now: tuple[Array, Array] = (np.zeros(3), np.zeros(3))  # held at the last time asked for
        self._newest: tuple[Array | None, Array | None] = (None, None)
        self._stamps: dict[str, int] = {}
        self.disordered = 0
        """Samples that were older than one of the same kind before."""

    @property
    def stamp(self) -> int | None:
        """When the older one of the last velocity and the last turn rate was taken; None: one has never come."""
        return min(self._stamps.values()) if len(self._stamps) == 2 else None

    @property
    def twist(self) -> tuple[Array, Array]:
        """The newest velocity, m/s, and turn rate, rad/s; zero where none has come."""
        v, w = self._newest
        return np.zeros(3) if v is None else v, np.zeros(3) if w is None else w

    def put(self, stamp: int, twist: Twist) -> None:
        """Take a sample of the velocity, of the turn rate, or of both."""
        parts = {"linear": twist.linear, "angular": twist.angular}
        known = [name for name, part in parts.items() if part is not None]
        if any(stamp <= self._stamps.get(name, -1) for name in known):
            self.disordered += 1
            return
        self._stamps.update(dict.fromkeys(known, stamp))
        v, w = self._newest
        self._newest = (v if twist.linear is None else twist.linear, w if twist.angular is None else twist.angular)
        self._insert(stamp, twist)
        if len(self._samples) > MOST_SAMPLES:
            _, v, w = self._samples.popleft()
            self._now = v, w

    def _insert(self, stamp: int, twist: Twist) -> None:
        """Keep the samples in order: those of two sensors come interleaved, later ones hold the new part as well."""
        later = []
        while self._samples and self._samples[-1][0] > stamp:
            later.append(self._samples.pop())
        _, v, w = self._samples[-1] if self._samples else (0, *self._now)
        v, w = (v if twist.linear is None else twist.linear), (w if twist.angular is None else twist.angular)
        self._samples.append((stamp, v, w))
        for since, v, w in reversed(later):  # the other sensor's: its own part stands, this one's is the new one
            part = (v if twist.linear is None else twist.linear), (w if twist.angular is None else twist.angular)
            self._samples.append((since, *part))

    def increment(self, begin: int, end: int) -> tuple[Array, Array]:
        """Return the rotation (3, 3) and translation (3,) in m from `begin` to `end`, and forget what was before."""
        R, p = np.eye(3), np.zeros(3)
        now = begin
        while self._samples and self._samples[0][0] <= end:
            since, v, w = self._samples.popleft()
            if since > now:
                R, p = self._go(R, p, since - now)
                now = since
            self._now = v, w
        if end > now:
            R, p = self._go(R, p, end - now)
        return R, p

    def _go(self, R: Array, p: Array, duration: int) -> tuple[Array, Array]:
        v, w = self._now
        seconds = duration * 1e-9
        turn, step = rigid_exp(w * seconds, v * seconds)
        return R.dot(turn), p + R.dot(step)
