"""What may go wrong with a fake car, on request: `KIND[=VALUE][@START[+DURATION]]`."""

import heapq
import itertools
import os
import random
import re
import signal
import threading
from collections.abc import Callable
from dataclasses import dataclass

from coopenv.base.errors import CoopenvError, listed, shown, suggest
from coopenv.cars.profile import PREFIX
from coopenv.cars.transport.base import Arrival, Callback, Transport


class FaultError(CoopenvError):
    """A fault is not one."""


@dataclass(frozen=True)
class Kind:
    """What a kind of fault does, and what its value means."""

    meaning: str
    default: float | None  # None: a value is needed
    low: float
    high: float


KINDS = {
    "freeze": Kind("its computer stands still: nothing is sent, no command is obeyed", 1.0, 1.0, 1.0),
    "kill": Kind("the process ends at once", 1.0, 1.0, 1.0),
    "loss": Kind("share of all messages that are lost, both ways", None, 0.0, 1.0),
    "delay": Kind("s by which all messages come later, both ways", None, 0.0, 60.0),
    "clock_offset": Kind("s that its clock is ahead", None, -1e6, 1e6),
    "clock_drift": Kind("s per second that its clock gains", None, -0.1, 0.1),
    "false_blocks": Kind("per second, blocks of the camera where nothing is", None, 0.0, 1e3),
    "duplicate_blocks": Kind("share of blocks that are reported twice", 1.0, 0.0, 1.0),
    "swapped_signatures": Kind("blocks of a frame have each other's numbers", 1.0, 1.0, 1.0),
}
FORM = re.compile(r"(?P<kind>\w+)(=(?P<value>[^@]+))?(@(?P<start>[^+]+)(\+(?P<duration>.+))?)?")


@dataclass(frozen=True)
class FakeFault:
    """One fault."""

    kind: str
    value: float
    start: float = 0.0  # s after it is asked for
    duration: float = float("inf")  # s


def parse_fault(text: str) -> FakeFault:
    """Read a fault, for example `loss=0.2@5+10`.

    Raises:
        FaultError: the kind is unknown, or a number is none or out of bounds.
    """
    found = FORM.fullmatch(text.strip())
    if found is None:
        raise FaultError(f"fault {shown(text)}: expected KIND[=VALUE][@START[+DURATION]]; kinds: {listed([*KINDS])}")
    name = found["kind"]
    if name not in KINDS:
        raise FaultError(f"unknown fault {shown(name)}{suggest(name, KINDS)}; known: {listed([*KINDS])}")
    kind = KINDS[name]
    if found["value"] is None and kind.default is None:
        raise FaultError(f"fault {name}: needs a value, {name}=NUMBER ({kind.meaning})")
    value = kind.default if found["value"] is None else _number(name, "value", found["value"], kind.low, kind.high)
    start = _number(name, "start", found["start"] or "0", 0.0, 1e6)
    duration = float("inf") if found["duration"] is None else _number(name, "duration", found["duration"], 0.0, 1e6)
    return FakeFault(name, float(value or 0.0), start, duration)


def _number(name: str, what: str, text: str, low: float, high: float) -> float:
    try:
        number = float(text)
    except ValueError:
        number = float("nan")
    if not low <= number <= high:
        raise FaultError(f"fault {name}: {what} {shown(text)} must be a number from {low:g} to {high:g}")
    return number


def fault_topic(car: str) -> str:
    """Return where a fake car hears of faults that it is to have, std_msgs/msg/String."""
    return f"{PREFIX}/{car}/coopenv/fault"


def end_process() -> None:
    """End this process as if its computer had been switched off."""
    os.kill(os.getpid(), signal.SIGKILL)


class Faults:
    """The faults of a car; times in ns on one clock."""

    def __init__(self) -> None:
        self._known: list[tuple[int, int | None, FakeFault]] = []

    def __bool__(self) -> bool:
        """Whether any has been asked for."""
        return bool(self._known)

    def add(self, fault: FakeFault, now: int) -> None:
        """Let a fault happen, its start counted from now."""
        begin = now + round(fault.start * 1e9)
        end = None if fault.duration == float("inf") else begin + round(fault.duration * 1e9)
        self._known.append((begin, end, fault))

    def value(self, kind: str, now: int) -> float:
        """Return the value of a kind of fault, 0 where it does not happen; of several the last that was asked for."""
        if not self._known:
            return 0.0
        return next((f.value for _, f in self._active(kind, now)), 0.0)

    def clock_error(self, now: int) -> int:
        """Return how far the car's clock is ahead, ns."""
        if not self._known:
            return 0
        offset = self.value("clock_offset", now) * 1e9
        drifted = next((f.value * (now - begin) for begin, f in self._active("clock_drift", now)), 0.0)
        return round(offset + drifted)

    def _active(self, kind: str, now: int) -> list[tuple[int, FakeFault]]:
        return [
            (begin, fault)
            for begin, end, fault in reversed(self._known)
            if fault.kind == kind and begin <= now and (end is None or now < end)
        ]


class Wire:
    """A transport on which messages get lost, come late, or stop, both ways; whoever holds it calls `flush`."""

    def __init__(self, transport: Transport, faults: Faults, steady: Callable[[], int], seed: int) -> None:
        """Lay it.

        Args:
            transport: what carries the messages; stays the caller's.
            faults: that it has.
            steady: the clock that they go by, ns.
            seed: of what is lost.
        """
        self._transport, self._faults, self._steady = transport, faults, steady
        self._rng, self._lock = random.Random(seed), threading.Lock()
        self._late: list[tuple[int, int, Callable[[], None]]] = []
        self._numbers = itertools.count()

    def publish(
        self, topic: str, payload: bytes, attachment: bytes = b"", *, urgent: bool = False, reliable: bool = False
    ) -> None:
        """Send, see `Transport`."""
        self._pass_on(lambda: self._transport.publish(topic, payload, attachment, urgent=urgent, reliable=reliable))

    def subscribe(self, pattern: str, callback: Callback) -> None:
        """Subscribe, see `Transport`."""

        def arrive(arrival: Arrival) -> None:
            self._pass_on(lambda: callback(arrival))

        self._transport.subscribe(pattern, arrive)

    def announce(self, name: str) -> None:
        """Announce, see `Transport`."""
        self._transport.announce(name)

    def watch(self, pattern: str, callback: Callable[[str, bool], None]) -> None:
        """Watch, see `Transport`."""
        self._transport.watch(pattern, callback)

    def close(self) -> None:
        """Forget what is under way."""
        with self._lock:
            self._late.clear()

    def flush(self) -> None:
        """Pass on what has been under way for long enough."""
        now = self._steady()
        while self._late:
            with self._lock:
                if not self._late or self._late[0][0] > now:
                    return
                _, _, act = heapq.heappop(self._late)
            act()

    def _pass_on(self, act: Callable[[], None]) -> None:
        if not self._faults:
            act()
            return
        now, faults = self._steady(), self._faults
        if faults.value("freeze", now) or self._rng.random() < faults.value("loss", now):
            return
        if delay := faults.value("delay", now):
            with self._lock:
                heapq.heappush(self._late, (now + round(delay * 1e9), next(self._numbers), act))
            return
        act()
