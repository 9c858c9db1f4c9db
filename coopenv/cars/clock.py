"""Clocks of stations and cars: real time, and simulated time that passes only while the station waits."""

import threading
import time
from collections.abc import Callable
from typing import ClassVar, Protocol

from coopenv.cars.gate import GateClock


class Repetition(Protocol):
    """An action that a clock repeats."""

    def is_alive(self) -> bool:
        """Return False after the end."""
        ...

    def end(self) -> None:
        """End it."""
        ...


class Clock(GateClock):
    """Real time of this computer; a station waits by it and repeats actions."""

    simulated: ClassVar[bool] = False

    def __init__(self, wall: Callable[[], int] = time.time_ns, steady: Callable[[], int] = time.monotonic_ns) -> None:
        """Take the two times of a gate's clock, ns."""
        super().__init__(wall, steady)

    def seconds(self) -> float:
        """Return the steady time, s."""
        return self.steady() * 1e-9

    def sleep(self, seconds: float) -> None:
        """Return after a time, s."""
        time.sleep(seconds)

    def repeat(self, period: float, act: Callable[[], None], name: str) -> Repetition:
        """Let an action begin `period` s after the end of the one before, in a thread of that name."""
        return _Thread(period, act, name)


CLOCK = Clock()


class _Thread(threading.Thread):
    def __init__(self, period: float, act: Callable[[], None], name: str) -> None:
        super().__init__(name=name, daemon=True)
        self._period, self._act, self._ended = period, act, threading.Event()
        self.start()

    def run(self) -> None:
        while not self._ended.wait(self._period):
            self._act()

    def end(self) -> None:
        self._ended.set()
        self.join(timeout=1.0)


class Participant(Protocol):
    """A program on a simulated clock, such as a fake car."""

    @property
    def next(self) -> int:
        """Steady time of its next event, ns."""
        ...

    def advance(self) -> None:
        """Do all that is due, and move `next` into the future."""
        ...


class SimulatedClock(Clock):
    """Time that passes only in `sleep`: participants do what is due until then, each event at its time.

    All run in the thread that sleeps, the participants at equal times in the order of their joining. So a drive depends
    on its seeds alone, and neither on the load of the computer nor on its speed. Computing takes no time.
    """

    simulated = True

    def __init__(self) -> None:
        """Begin at the computer's present time."""
        self._now, begin = 10**9, time.time_ns()
        self._participants: list[Participant] = []
        super().__init__(lambda: begin + self._now, lambda: self._now)

    def join(self, participant: Participant) -> None:
        """Let a program take part from now on."""
        self._participants.append(participant)

    def sleep(self, seconds: float) -> None:
        """Let a time pass, s."""
        until = self._now + round(seconds * 1e9)
        while (first := min(self._participants, key=lambda one: one.next, default=None)) and first.next <= until:
            self._now = max(self._now, first.next)
            first.advance()
        self._now = until

    def repeat(self, period: float, act: Callable[[], None], name: str) -> Repetition:
        """Repeat an action at each period, s."""
        return _Repeated(self._participants, self._now, round(period * 1e9), act)


class _Repeated:
    def __init__(self, among: list[Participant], now: int, period: int, act: Callable[[], None]) -> None:
        self._among, self.next, self._period, self._act = among, now + period, period, act
        among.append(self)

    def advance(self) -> None:
        self.next += self._period
        self._act()

    def is_alive(self) -> bool:
        return self in self._among

    def end(self) -> None:
        if self in self._among:
            self._among.remove(self)
