"""Clocks of stations and cars: real time, and simulated time that passes only while the station waits."""

import threading
import time
from collections.abc import Callable
from typing import ClassVar

from coopenv.cars.gate.gate import GateClock

POLL = 0.01  # s
End = Callable[[], None]
"""Ends something that is repeated; may be called again."""


class Clock(GateClock):
    """Real time of this computer; a station waits by it and repeats actions."""

    simulated: ClassVar[bool] = False

    def seconds(self) -> float:
        """Return the steady time, s."""
        return self.steady() * 1e-9

    def sleep(self, seconds: float) -> None:
        """Return after a time, s."""
        time.sleep(seconds)

    def wait(self, ready: Callable[[], object], patience: float) -> None:
        """Return as soon as something is true, after some s at most."""
        until = self.seconds() + patience
        while not ready() and self.seconds() < until:
            self.sleep(POLL)

    def repeat(self, period: float, act: Callable[[], None], name: str) -> End:
        """Let an action begin `period` s after the end of the one before, in a thread of that name."""
        ended = threading.Event()

        def run() -> None:
            while not ended.wait(period):
                act()

        def end() -> None:
            ended.set()
            thread.join(timeout=1.0)

        thread = threading.Thread(target=run, name=name, daemon=True)
        thread.start()
        return end


CLOCK = Clock()


class SimulatedClock(Clock):
    """Time that passes only in `sleep`: what is due until then happens first, each event at its time.

    All runs in the thread that sleeps; at equal times the participant that joined first is first. Computing takes no
    time, so that a drive depends on its seeds alone, whatever the load.
    """

    simulated = True

    def __init__(self) -> None:
        """Begin at the computer's present time."""
        self._now, begin = 10**9, time.time_ns()
        self._participants: list[tuple[Callable[[], int], Callable[[], None]]] = []
        super().__init__(lambda: begin + self._now, lambda: self._now)

    def join(self, due: Callable[[], int], act: Callable[[], None]) -> End:
        """Let an action happen whenever it is due: `due` returns the steady time, ns, which the action moves on."""
        participant = due, act
        self._participants.append(participant)

        def end() -> None:
            self._participants = [other for other in self._participants if other is not participant]

        return end

    def sleep(self, seconds: float) -> None:
        """Let a time pass, s."""
        until = self._now + round(seconds * 1e9)
        while self._participants:
            due, act = min(((due(), act) for due, act in self._participants), key=lambda event: event[0])
            if due > until:
                break
            self._now = max(self._now, due)
            act()
        self._now = until

    def repeat(self, period: float, act: Callable[[], None], name: str) -> End:
        """Repeat an action at each period, s."""
        due, step = self._now, round(period * 1e9)

        def again() -> None:
            nonlocal due
            due += step
            act()

        return self.join(lambda: due + step, again)
