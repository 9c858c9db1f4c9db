"""A gate in a process of its own, a router, and the station that talks to it."""

from __future__ import annotations

import subprocess
import time
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from typing import Any

from coopenv.cars.gate.wheel_command import MotionCommand, read_drive
from coopenv.cars.link.keys import Signer
from coopenv.cars.link.transport import Transport
from coopenv.cars.messages.cdr import Malformed
from coopenv.cars.messages.codec import decode
from coopenv.cars.settings.profile import SVEA, Role, presence_of
from tests.cars.gate import messages
from tests.cars.gate.bench import CAR
from tests.helpers.processes import COOPENV, started, wait_until
from tests.helpers.wire import heard_by, seen_by


def running_gate(endpoint: str, folder: Path, *options: str) -> AbstractContextManager[subprocess.Popen[str]]:
    return started((*COOPENV, "svea", "gate", "--car", CAR, "--connect", endpoint, *options), folder)


class Station:
    """Hears a gate and drives through it."""

    def __init__(self, transport: Transport, signer: Signer | None) -> None:
        self._transport, self._signer = transport, signer
        topics = (SVEA.topic_of(CAR, role) for role in (Role.GATE, Role.MANUAL, Role.STOP))
        self.statuses, self._wheels, self.stops = (heard_by(transport, topic) for topic in topics)
        self._seen = seen_by(transport)
        self.session, self.sequence = "", 0

    @property
    def status(self) -> Any:
        """The last status; None: there has been none."""
        return decode(self.statuses[-1].payload, SVEA.topics[Role.GATE].type) if self.statuses else None

    @property
    def present(self) -> bool:
        """True if the car is present."""
        return dict(self._seen).get(presence_of(CAR), False)

    def since(self, when: float = 0.0) -> list[MotionCommand]:
        """Return the car's commands since an instant of the wall clock, s."""
        outputs = []
        for arrival in self._wheels.copy():
            if arrival.received >= 1e9 * when:
                with suppress(Malformed):
                    outputs.append(read_drive(arrival.payload, SVEA.command))
        return outputs

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
        """Send commands until the gate commands the car to move."""
        begun = time.time()

        def moves() -> bool:
            self.command()
            time.sleep(0.04)
            return any(drive.speed > 0.01 for drive in self.since(begun))

        wait_until(moves)
