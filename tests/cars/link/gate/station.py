"""A gate in a process of its own, a router, and the station that talks to it."""

from __future__ import annotations

import subprocess
import threading
import time
from collections import deque
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from typing import Any

from coopenv.cars.codec import decode
from coopenv.cars.gate.core import Malformed, read_drive
from coopenv.cars.keys import Signer
from coopenv.cars.profile import SVEA, MotionCommand, Role, presence_of
from coopenv.cars.transport.base import Arrival, Transport
from tests.cars.link.gate import messages
from tests.cars.link.gate.bench import CAR
from tests.helpers.processes import COOPENV, started, wait_until


def running_gate(endpoint: str, folder: Path, *options: str) -> AbstractContextManager[subprocess.Popen[str]]:
    return started((*COOPENV, "svea", "gate", "--car", CAR, "--connect", endpoint, *options), folder)


class Station:
    """Hears a gate and drives through it."""

    def __init__(self, transport: Transport, signer: Signer | None) -> None:
        self._transport, self._signer = transport, signer
        self._lock = threading.Lock()
        self.status: Any = None
        self.statuses, self.outputs, self.stops = 0, deque[tuple[float, MotionCommand]](maxlen=1000), 0
        self.present = False
        self.session, self.sequence = "", 0
        transport.subscribe(SVEA.topic_of(CAR, Role.GATE), self._hear)
        transport.subscribe(SVEA.topic_of(CAR, Role.MANUAL), self._see)
        transport.subscribe(SVEA.topic_of(CAR, Role.STOP), self._halt)
        transport.watch(presence_of("*"), self._watch)

    def _hear(self, arrival: Arrival) -> None:
        self.status, self.statuses = decode(arrival.payload, SVEA.topics[Role.GATE].type), self.statuses + 1

    def _see(self, arrival: Arrival) -> None:
        with suppress(Malformed), self._lock:
            drive = read_drive(arrival.payload, SVEA.command)
            self.outputs.append((time.monotonic(), drive))

    def _halt(self, _arrival: Arrival) -> None:
        self.stops += 1

    def _watch(self, name: str, there: bool) -> None:
        if name == presence_of(CAR):
            self.present = there

    def since(self, when: float) -> list[MotionCommand]:
        """Return what the car has been told since an instant of the monotonic clock."""
        with self._lock:
            return [drive for at, drive in self.outputs if at >= when]

    def count(self, reason: str) -> int:
        return int(dict(zip(self.status.rejections, self.status.counts, strict=True))[reason])

    def send(self, role: Role, payload: bytes) -> None:
        topic = SVEA.topic_of(CAR, role)
        attachment = b"" if self._signer is None else self._signer.sign(topic, payload)
        self._transport.publish(
            topic, payload, attachment, urgent=SVEA.topics[role].urgent, reliable=SVEA.topics[role].reliable
        )

    def send_raw(self, role: Role, payload: bytes, attachment: bytes) -> None:
        self._transport.publish(SVEA.topic_of(CAR, role), payload, attachment, reliable=True)

    def arm(self, session: str) -> None:
        """Arm the gate, and wait until it says that it is."""
        self.session, self.sequence = session, 0

        def is_armed() -> bool:
            return self.status is not None and (self.status.state, self.status.session) == ("armed", session)

        def ask() -> None:
            if self.status is not None and not is_armed():
                self.send(Role.ARM, messages.arm(time.time_ns(), session, self.status.nonce))
                time.sleep(0.05)

        wait_until(is_armed, ask)

    def command(self, speed: float = 0.3) -> None:
        self.sequence += 1
        self.send(Role.COMMAND, messages.command(time.time_ns(), self.session, self.sequence, 0.1, speed))

    def drive(self) -> None:
        """Send commands until the car is told to move."""
        begun = time.monotonic()

        def moves() -> bool:
            self.command()
            time.sleep(0.04)
            return any(drive.speed > 0.01 for drive in self.since(begun))

        wait_until(moves)
