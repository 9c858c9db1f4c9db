"""The gate on the network: messages come in by callbacks, the car's command goes out 20 times a second."""

import secrets
import threading
import time
from functools import partial

from coopenv.svea.gate.codec import write_bool
from coopenv.svea.gate.core import PERIOD, Gate
from coopenv.svea.gate.terms import Clock, State
from coopenv.svea.signing import Signer
from coopenv.svea.topics import TOPICS, Role, presence_of, topic_of
from coopenv.svea.transport.base import Arrival, Transport

CLOCK = Clock(time.time_ns, time.monotonic_ns)
TICKS_PER_STATUS = 4  # 5 Hz
LAST_NEUTRALS = 5  # that the car gets before the gate goes


class Link:
    """A gate and its connection; whoever holds it calls `tick` every 50 ms, from one thread."""

    def __init__(self, gate: Gate, car: str, transport: Transport, signer: Signer | None = None) -> None:
        """Listen, and announce the car.

        Args:
            gate: decides; from now on nobody else is to call it.
            car: its name.
            transport: stays the caller's, who closes it.
            signer: signs the status, as the car; None: it is not signed.
        """
        self._gate, self._transport, self._signer = gate, transport, signer
        self._topics = {role: topic_of(car, role) for role in TOPICS}
        self._lock = threading.Lock()
        self._ticks = 0
        self._own = secrets.token_bytes(16)  # marks what comes back to us: it must not stop a car that is armed again
        self.news = threading.Event()
        """Set when the state or the nonce has changed: `tell` then says so at once."""
        for role in (Role.COMMAND, Role.ARM, Role.STOP):
            transport.subscribe(self._topics[role], partial(self._arrive, role))
        transport.announce(presence_of(car))

    def tick(self) -> bytes:
        """Send the car's command, and every 0.2 s the status; return the command, a ManualControl."""
        with self._lock:
            payload = self._gate.tick()
        self._send(Role.MANUAL, payload)
        if self._ticks % TICKS_PER_STATUS == 0:
            self.tell()
        self._ticks += 1
        return payload

    @property
    def commanded(self) -> int:
        """When the last valid command came, steady clock, ns."""
        with self._lock:
            return self._gate.commanded

    def tell(self) -> None:
        """Send the status, and that the car has been stopped if it has."""
        self.news.clear()
        with self._lock:
            state, status = self._gate.state, self._gate.status()
        signature = b"" if self._signer is None else self._signer.sign(self._topics[Role.GATE], status)
        self._send(Role.GATE, status, signature)
        if state is State.STOPPED:
            self._send(Role.STOP, write_bool(True), self._own)

    def neutral(self) -> bytes:
        """Close the gate for good and send the car a neutral command, which is returned."""
        with self._lock:
            payload = self._gate.neutral()
        self._send(Role.MANUAL, payload)
        return payload

    def _arrive(self, role: Role, arrival: Arrival) -> None:
        if role is Role.STOP and arrival.attachment == self._own:
            return
        with self._lock:
            before = (self._gate.state, self._gate.nonce)
            self._gate.arrive(role, arrival.payload, arrival.attachment)
            changed = (self._gate.state, self._gate.nonce) != before
        if changed:
            self.news.set()

    def _send(self, role: Role, payload: bytes, attachment: bytes = b"") -> None:
        topic = TOPICS[role]
        self._transport.publish(self._topics[role], payload, attachment, urgent=topic.urgent, reliable=topic.reliable)


def run(link: Link) -> None:
    """Tick until an exception, such as that of a signal, ends it; the car then gets neutral before that goes on."""
    due = time.monotonic_ns()
    try:
        while True:
            wait = (due - time.monotonic_ns()) / 1e9
            if wait > 0.0 and link.news.wait(wait):
                link.tell()
            elif wait <= 0.0 or time.monotonic_ns() >= due:
                link.tick()
                missed = max(time.monotonic_ns() - due, 0) // PERIOD
                due += (missed + 1) * PERIOD
    finally:
        for _ in range(LAST_NEUTRALS):
            link.neutral()
            time.sleep(PERIOD / 1e9)
