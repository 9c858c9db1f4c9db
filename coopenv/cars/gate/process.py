"""The gate on the network: messages come in by callbacks, the car's command goes out 20 times a second."""

import os
import secrets
import socket
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from coopenv.base.errors import CoopenvError
from coopenv.cars.gate.gate import PERIOD, Gate, GateClock, GateMode
from coopenv.cars.gate.wheel_command import NEUTRAL, read_drive
from coopenv.cars.link.keys import Signer, check_identity, load_keys
from coopenv.cars.link.transport import SECURE, Arrival, Transport, address_of
from coopenv.cars.messages.cdr import Malformed, write
from coopenv.cars.settings.deployment import Car, Deployment, load_deployment
from coopenv.cars.settings.profile import Role, presence_of

TICKS_PER_STATUS = 4  # 5 Hz
LAST_NEUTRALS = 5  # that the car gets before the gate goes
MOST_SENT = 1200  # own commands that may be under way: a minute


@dataclass(eq=False, repr=False)
class GateConnection:
    """A gate and its connection; its owner calls `tick` every 50 ms, from one thread."""

    gate: Gate  # used by this connection alone
    transport: Transport  # the caller's, which closes it
    signer: Signer | None = None  # signs the status, as the car; None: it is not signed

    def __post_init__(self) -> None:
        """Listen, and announce the car."""
        gate, transport = self.gate, self.transport
        self._topics = {role: gate.profile.topic_of(gate.car, role) for role in Role}
        self._lock = threading.Lock()
        self._ticks = 0
        self._own = secrets.token_bytes(16)  # marks what comes back to us: it must not stop a car that is armed again
        self._sent: dict[bytes, bool] = {}  # own commands that have not come back yet, oldest first
        self.news = threading.Event()
        """Set when the state or the nonce has changed, so that the status is published at once."""
        for role in (Role.COMMAND, Role.ARM, Role.STOP):
            transport.subscribe(self._topics[role], partial(self._arrive, role))
        transport.announce(presence_of(gate.car))

    def guard(self) -> None:
        """Stop the car from now on at the first command to its wheels that is not this gate's.

        The network must pass on what this end publishes to this end as well, as Zenoh does.
        """
        # The wildcard stands for nothing: it admits messages under wildcard keys, which reach the wheels as well.
        self.transport.subscribe(f"{self._topics[Role.MANUAL]}/**", self._guard)

    def _guard(self, arrival: Arrival) -> None:
        payload = arrival.payload
        with self._lock:
            if self._sent.pop(payload, False):
                return
            self.gate.foreign()
            answer = self.gate.tick()
        self.news.set()
        try:
            harmless = read_drive(payload, self.gate.profile.command) == NEUTRAL
        except Malformed:  # to us, perhaps not to the car
            harmless = False
        if not harmless:  # so that two gates of one car do not answer each other for ever
            self._send(Role.MANUAL, answer)

    def tick(self) -> bytes:
        """Send the car's command, and every 0.2 s the status; return the command."""
        with self._lock:
            payload = self.gate.tick()
        self._send(Role.MANUAL, payload)
        if self._ticks % TICKS_PER_STATUS == 0:
            self.publish_status()
        self._ticks += 1
        return payload

    @property
    def commanded(self) -> int:
        """Time of the last valid command, steady clock, ns."""
        with self._lock:
            return self.gate.commanded

    def publish_status(self) -> None:
        """Send the status, and that the car has been stopped if it has."""
        self.news.clear()
        with self._lock:
            state, status = self.gate.state, self.gate.status()
        signature = b"" if self.signer is None else self.signer.sign(self._topics[Role.GATE], status)
        self._send(Role.GATE, status, signature)
        if state is GateMode.STOPPED:
            self._send(Role.STOP, write("?", True), self._own)

    def neutral(self) -> bool:
        """Close the gate for good and send the car a neutral command, unless it is braking; return whether it was."""
        with self._lock:
            payload, braking = self.gate.neutral(), self.gate.braking
        self._send(Role.MANUAL, payload)
        return not braking

    def _arrive(self, role: Role, arrival: Arrival) -> None:
        if role is Role.STOP and arrival.attachment == self._own:
            return
        with self._lock:
            before = (self.gate.state, self.gate.nonce)
            self.gate.arrive(role, arrival.payload, arrival.attachment)
            changed = (self.gate.state, self.gate.nonce) != before
        if changed:
            self.news.set()

    def _send(self, role: Role, payload: bytes, attachment: bytes = b"") -> None:
        if role is Role.MANUAL:
            with self._lock:
                self._sent[payload] = True
                if len(self._sent) > MOST_SENT:
                    del self._sent[next(iter(self._sent))]
        self.transport.publish(self._topics[role], payload, attachment, **self.gate.profile.topics[role].way)


def notify_systemd(state: str) -> None:
    """Report to systemd, if it started this process: alive (`WATCHDOG=1`) or ready (`READY=1`)."""
    if place := os.environ.get("NOTIFY_SOCKET"):
        with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
            sender.sendto(state.encode(), "\0" + place[1:] if place.startswith("@") else place)


def run(link: GateConnection) -> None:
    """Tick until an exception, such as that of a signal, ends it; the car then gets neutral before that goes on.

    systemd restarts a process that no longer ticks: `WatchdogSec`.
    """
    due = time.monotonic_ns()
    notify_systemd("READY=1")
    try:
        while True:
            wait = (due - time.monotonic_ns()) / 1e9
            if wait > 0.0 and link.news.wait(wait):
                link.publish_status()
            elif wait <= 0.0 or time.monotonic_ns() >= due:
                link.tick()
                notify_systemd("WATCHDOG=1")
                missed = max(time.monotonic_ns() - due, 0) // PERIOD
                due += (missed + 1) * PERIOD
    finally:
        left = LAST_NEUTRALS
        while left:
            left -= link.neutral()
            time.sleep(PERIOD / 1e9)


def gate_deployment(car: str, path: Path | None, connect: str | None = None, off_board: bool = False) -> Deployment:
    """Return a deployment whose network is that of a car's gate: the car's own router.

    Args:
        car: its name.
        path: deployment file; None: the usual settings.
        connect: endpoint in place of the file's.
        off_board: allow a router that is not on this computer, where neutral gets lost with the link.

    Raises:
        CoopenvError: the name is none, the file cannot be read, or knows no such car; an endpoint is none, or not on
            this computer.
    """
    if path is None:
        check_identity(car, "--car")
        fleet = Deployment(environment="", cars=(Car.model_construct(name=car),))
    else:
        fleet = load_deployment(path)
        fleet.car(car)
    endpoints = fleet.gate_connect if connect is None else (connect,)
    for endpoint in endpoints:
        if not address_of(endpoint).loopback and not off_board:
            raise CoopenvError(
                f"{endpoint}: is not on this computer, and when the link to it dies the wheels get no neutral: "
                "expected the car's own router, e.g. tcp/127.0.0.1:7447 ([gate] connect, --connect), or --off-board"
            )
    secure = any(address_of(endpoint).protocol in SECURE for endpoint in endpoints)
    tls = fleet.network.tls if secure else None  # on the car itself nothing need be
    network = fleet.network.model_copy(update={"connect": endpoints, "tls": tls})
    return fleet.model_copy(update={"network": network})


def prepare_gate(
    fleet: Deployment,
    car: str,
    station: str | None = None,
    keys: Path | None = None,
    limits: Mapping[str, Any] | None = None,
) -> Callable[[Transport, GateClock], GateConnection]:
    """Return the function that connects a car's gate to a network, checked as far as possible without one.

    Args:
        fleet: the fleet of the car.
        car: its name.
        station: identity that may arm and command (None: the fleet's).
        keys: folder of keys (None: the fleet's; without any nothing is signed, and any station can drive the car).
        limits: in place of the fleet's, by name; None leaves one as it is.

    Raises:
        CoopenvError: a limit is beyond the hardest, or a key is missing or unsafe.
    """
    profile, station, folder = fleet.profile, station or fleet.security.identity, keys or fleet.keys
    given = {name: value for name, value in (limits or {}).items() if value is not None}
    bounds = replace(fleet.limits, **given).check(profile.hardest)
    signer, verifier = load_keys(folder, car, [station])
    return lambda transport, clock: GateConnection(
        Gate(car, bounds, clock, verifier, station, profile), transport, signer
    )
