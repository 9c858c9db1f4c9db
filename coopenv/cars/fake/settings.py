"""Fake cars: processes that publish and accept what real cars do. They differ by settings and faults on request.

A fault is `NAME[=VALUE][@START[+DURATION]]`.
"""

import os
import random
import sched
import signal
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from math import isinf
from typing import Annotated, Unpack

from pydantic import Field

from coopenv.base.fault_text import Fault, FaultError, FaultKind, parse_fault
from coopenv.base.sections import Section
from coopenv.cars.link.transport import Arrival, Callback, Transport
from coopenv.cars.settings.limits import Number, Positive
from coopenv.cars.settings.profile import PREFIX, Way

Share = Annotated[float, Field(ge=0.0, lt=0.5)]
Seconds = Annotated[float, Field(ge=0.0, le=60.0)]


class FakeSettings(Section):
    """A fake car beyond its environment; `coopenv identify` measures a real one's."""

    latency: Seconds | None = None
    """Dead time from a command of the gate to the wheels, s (default: the environment's, from one of the station)."""
    speed_gain: Positive = 1.0
    """Speed per commanded speed."""
    steering_gain: Positive = 1.0
    """Steering angle per commanded angle."""
    steering_offset: Number = 0.0
    """Steering angle when straight on is commanded, rad, left is positive."""
    deceleration: Positive | None = None
    """Of a car that is faster than commanded, m/s^2 (default: the environment's acceleration)."""
    wheel_scale: Number | None = None
    """Share by which wheels measure too much (default: drawn as the environment states)."""
    gyro_bias: Number | None = None
    """Bias of the turn rate, rad/s (default: likewise)."""
    wheel_rate: Positive = 50.0
    """Velocities of the wheels per second."""
    imu_rate: Positive = 100.0
    """Turn rates per second."""
    marker: Positive = 0.08
    """Side of the markers, m: coloured ones, or the black squares of tags."""
    jitter: Share = 0.05
    """Largest deviation from regular times, share of a sensor's period."""
    loss: Share = 0.0
    """Share of messages that is lost on the radio, both ways."""
    delay: Seconds = 0.0
    """Delay of messages on the radio, s."""
    delay_spread: Seconds = 0.0
    """Mean of an exponentially distributed further delay, s."""


USUAL = FakeSettings()
AHEAD = 3.0  # s, of a wrong stamp
_Kind = partial(FaultKind, start=True, duration=True)
FAKE_FAULTS = {
    "freeze": _Kind("ON", "the computer stops: nothing is sent, no command is obeyed", 1.0, 1.0, 1.0),
    "kill": _Kind("ON", "the process ends at once", 1.0, 1.0, 1.0),
    "loss": _Kind("SHARE", "of all messages that is lost, both ways", None, 0.0, 1.0),
    "delay": _Kind("SECONDS", "by which all messages come later, both ways", None, 0.0, 60.0),
    "clock_offset": _Kind("SECONDS", "that its clock is ahead", None, -1e6, 1e6),
    "clock_drift": _Kind("RATE", "s per second that its clock gains", None, -0.1, 0.1),
    "wrong_stamps": _Kind("SHARE", f"of the camera's frames whose stamps are {AHEAD:g} s ahead", None, 0.0, 1.0),
    "false_blocks": _Kind("RATE", "per second, blocks of the camera without a marker", None, 0.0, 1e3),
    "duplicate_blocks": _Kind("SHARE", "of blocks that are reported twice", 1.0, 0.0, 1.0),
    "swapped_signatures": _Kind("ON", "blocks of a frame exchange their numbers", 1.0, 1.0, 1.0),
}
"""By name; a start is counted from the request."""


def fake_fault(text: str) -> Fault:
    """Read a fault of a fake car, for example `loss=0.2@5+10`. Raises FaultError: it is not valid."""
    fault = parse_fault(text, FAKE_FAULTS)
    if fault.is_share:
        raise FaultError(f"fault {fault.name}: a car's run has no length, so start must be a number of seconds")
    return fault


def fault_topic(car: str) -> str:
    """Return the topic on which a fake car receives faults, std_msgs/msg/String."""
    return f"{PREFIX}/{car}/coopenv/fault"


def end_process() -> None:
    """End this process as if its computer had been switched off."""
    os.kill(os.getpid(), signal.SIGKILL)


class CarFaults:
    """The faults of a car; times in ns on one clock."""

    def __init__(self) -> None:
        self._known: list[tuple[int, int | None, Fault]] = []

    def add(self, fault: Fault, now: int) -> None:
        """Let a fault happen, its start counted from now."""
        begin = now + round(fault.start_in(0.0) * 1e9)
        end = None if isinf(fault.duration) else begin + round(fault.duration * 1e9)
        self._known.append((begin, end, fault))

    def value(self, kind: str, now: int) -> float:
        """Return the value of a kind of fault, 0 where it does not happen; of several the last that was asked for."""
        return next((f.value for _, f in self._active(kind, now)), 0.0)

    def clock_error(self, now: int) -> int:
        """Return how far the car's clock is ahead, ns."""
        offset = self.value("clock_offset", now) * 1e9
        drifted = next((f.value * (now - begin) for begin, f in self._active("clock_drift", now)), 0.0)
        return round(offset + drifted)

    def _active(self, kind: str, now: int) -> list[tuple[int, Fault]]:
        return [
            (begin, fault)
            for begin, end, fault in reversed(self._known)
            if fault.name == kind and begin <= now and (end is None or now < end)
        ]


@dataclass(eq=False, repr=False)
class Wire:
    """A transport on which messages get lost, come late, or stop, both ways; its owner calls `flush`."""

    transport: Transport  # stays the caller's
    faults: CarFaults
    steady: Callable[[], int]  # the clock that faults go by, ns
    seed: int  # of what is lost
    settings: FakeSettings

    def __post_init__(self) -> None:
        """Lay it."""
        self.announce, self.watch, self.clock = self.transport.announce, self.transport.watch, self.transport.clock
        self._rng, self._late = random.Random(self.seed), sched.scheduler(self.steady, lambda _: None)

    def publish(self, topic: str, payload: bytes, attachment: bytes = b"", **way: Unpack[Way]) -> None:
        """Send, see `Transport`."""
        self._pass_on(lambda: self.transport.publish(topic, payload, attachment, **way))

    def subscribe(self, pattern: str, callback: Callback) -> None:
        """Subscribe, see `Transport`."""

        def arrive(arrival: Arrival) -> None:
            self._pass_on(lambda: callback(arrival))

        self.transport.subscribe(pattern, arrive)

    def close(self) -> None:
        """Forget what is under way."""
        for message in self._late.queue:
            self._late.cancel(message)

    @property
    def next(self) -> float:
        """When the next late message is due, ns; inf: none is under way."""
        return min((message.time for message in self._late.queue), default=float("inf"))

    def flush(self) -> None:
        """Pass on what has been under way for long enough."""
        self._late.run(blocking=False)

    def _pass_on(self, act: Callable[[], None]) -> None:
        now, faults, lasting = self.steady(), self.faults, self.settings
        loss = max(lasting.loss, faults.value("loss", now))
        if faults.value("freeze", now) or (loss and self._rng.random() < loss):
            return
        delay = lasting.delay + faults.value("delay", now)
        if lasting.delay_spread:
            delay += self._rng.expovariate(1.0 / lasting.delay_spread)
        if delay:
            self._late.enterabs(now + round(delay * 1e9), 0, act)
        else:
            act()
