"""The gate on the network: messages come in by callbacks, the car's command goes out 20 times a second."""

from __future__ import annotations

import secrets
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from coopenv.base.errors import CoopenvError, shown
from coopenv.cars.gate.core import PERIOD, Gate, GateClock, GateMode, write
from coopenv.cars.keys import (
    LONGEST_IDENTITY,
    Signer,
    Verifier,
    check_known,
    is_identity,
    load_signer,
    load_verifier,
)
from coopenv.cars.profile import SVEA, USUAL, CarProfile, Limits, Role, presence_of
from coopenv.cars.transport.base import SECURE, Arrival, Transport, address_of

if TYPE_CHECKING:
    from coopenv.cars.deployment import Deployment

CLOCK = GateClock(time.time_ns, time.monotonic_ns)
TICKS_PER_STATUS = 4  # 5 Hz
LAST_NEUTRALS = 5  # that the car gets before the gate goes


class GateConnection:
    """A gate and its connection; its owner calls `tick` every 50 ms, from one thread."""

    def __init__(
        self, gate: Gate, car: str, transport: Transport, signer: Signer | None = None, profile: CarProfile = SVEA
    ) -> None:
        """Listen, and announce the car.

        Args:
            gate: decides; used by this connection alone from now on.
            car: its name.
            transport: the caller's, which closes it.
            signer: signs the status, as the car; None: it is not signed.
            profile: make of the car.
        """
        self._gate, self._transport, self._signer = gate, transport, signer
        self._profile = profile
        self._topics = {role: profile.topic_of(car, role) for role in Role}
        self._lock = threading.Lock()
        self._ticks = 0
        self._own = secrets.token_bytes(16)  # marks what comes back to us: it must not stop a car that is armed again
        self.news = threading.Event()
        """Set when the state or the nonce has changed, so that the status is published at once."""
        for role in (Role.COMMAND, Role.ARM, Role.STOP):
            transport.subscribe(self._topics[role], partial(self._arrive, role))
        transport.announce(presence_of(car))

    def tick(self) -> bytes:
        """Send the car's command, and every 0.2 s the status; return the command."""
        with self._lock:
            payload = self._gate.tick()
        self._send(Role.MANUAL, payload)
        if self._ticks % TICKS_PER_STATUS == 0:
            self.publish_status()
        self._ticks += 1
        return payload

    @property
    def commanded(self) -> int:
        """When the last valid command came, steady clock, ns."""
        with self._lock:
            return self._gate.commanded

    def publish_status(self) -> None:
        """Send the status, and that the car has been stopped if it has."""
        self.news.clear()
        with self._lock:
            state, status = self._gate.state, self._gate.status()
        signature = b"" if self._signer is None else self._signer.sign(self._topics[Role.GATE], status)
        self._send(Role.GATE, status, signature)
        if state is GateMode.STOPPED:
            self._send(Role.STOP, write("?", True), self._own)

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
        topic = self._profile.topics[role]
        self._transport.publish(self._topics[role], payload, attachment, urgent=topic.urgent, reliable=topic.reliable)


def run(link: GateConnection) -> None:
    """Tick until an exception, such as that of a signal, ends it; the car then gets neutral before that goes on."""
    due = time.monotonic_ns()
    try:
        while True:
            wait = (due - time.monotonic_ns()) / 1e9
            if wait > 0.0 and link.news.wait(wait):
                link.publish_status()
            elif wait <= 0.0 or time.monotonic_ns() >= due:
                link.tick()
                missed = max(time.monotonic_ns() - due, 0) // PERIOD
                due += (missed + 1) * PERIOD
    finally:
        for _ in range(LAST_NEUTRALS):
            link.neutral()
            time.sleep(PERIOD / 1e9)


@dataclass(frozen=True)
class GateSettings:
    """Of one gate."""

    car: str
    connect: tuple[str, ...] = ("tcp/127.0.0.1:7447",)
    limits: Limits = USUAL
    keys: Path | None = None  # folder
    station: str = "station"
    fleet: Deployment | None = None  # of the file, if there is one

    @property
    def profile(self) -> CarProfile:
        """Make of the car."""
        return SVEA if self.fleet is None else self.fleet.profile

    @classmethod
    def of(cls, car: str, path: Path | None) -> GateSettings:
        """Return the settings for a car by a deployment file, or the usual ones.

        Raises:
            CoopenvError: the name is none, the file cannot be read, or knows no such car.
        """
        if path is None:
            if not is_identity(car):
                raise CoopenvError(f"--car {shown(car)}: expected 1 to {LONGEST_IDENTITY} letters, digits, _ or -")
            return cls(car)
        from coopenv.cars.deployment import load_deployment

        read = load_deployment(path)
        keys = None if read.security.keys is None else read.folder / read.security.keys
        return cls(read.car(car).name, read.gate_connect, read.limits, keys, read.security.identity, read)

    def changed(self, limits: Mapping[str, Any], **values: Any) -> GateSettings:
        """Return these settings with others in place of some; None leaves one as it is.

        Raises:
            CoopenvError: a limit is beyond the hardest.
        """
        bounds = replace(self.limits, **{name: value for name, value in limits.items() if value is not None})
        rest = {name: value for name, value in values.items() if value is not None}
        return replace(self, limits=bounds.check(self.profile.hardest), **rest)

    def check_place(self, off_board: bool) -> None:
        """Refuse a router that is not on the car, where neutral would get lost with the link; `off_board` allows it.

        Raises:
            CoopenvError: an endpoint is none, or not on this computer.
        """
        for endpoint in self.connect:
            if not address_of(endpoint).loopback and not off_board:
                raise CoopenvError(
                    f"{endpoint}: is not on this computer, and when the link to it dies the wheels get no neutral: "
                    "expected the car's own router, e.g. tcp/127.0.0.1:7447 ([gate] connect, --connect), or --off-board"
                )

    def open(self) -> Transport:
        """Connect to the network; errors as for `coopenv.cars.transport.zenoh.open_transport`."""
        if self.fleet is None:
            from coopenv.cars.transport.zenoh import open_zenoh

            return open_zenoh("client", self.connect)
        from coopenv.cars.transport.zenoh import open_transport

        secure = any(address_of(endpoint).protocol in SECURE for endpoint in self.connect)
        tls = self.fleet.network.tls if secure else None  # on the car itself nothing need be
        network = self.fleet.network.model_copy(update={"connect": self.connect, "tls": tls})
        return open_transport(self.fleet.model_copy(update={"network": network}))

    def identities(self) -> tuple[Signer | None, Verifier | None]:
        """Return what signs as the car and what knows the station. Raises CoopenvError: a key is missing or unsafe."""
        if self.keys is None:
            return None, None
        own = None if self.fleet is None else self.fleet.security.keys
        if self.fleet is not None and own is not None and self.keys == self.fleet.folder / own:
            verifier = load_verifier(self.fleet.keys or self.keys)  # which names the field where there is none
        else:
            verifier = load_verifier(self.keys)
        check_known(verifier, self.station, self.keys)
        return load_signer(self.keys, self.car), verifier
