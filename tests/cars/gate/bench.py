"""A gate with clocks that stand still until a test advances them, its station, and messages of other senders."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from random import Random
from typing import Any

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from coopenv.cars.gate.gate import PERIOD, Gate, GateClock, Reason
from coopenv.cars.gate.wheel_command import MotionCommand, read_drive
from coopenv.cars.link.keys import Signer, Verifier
from coopenv.cars.messages.codec import decode, stamp_of
from coopenv.cars.settings.limits import Limits
from coopenv.cars.settings.profile import SVEA, Role
from tests.cars.gate import messages

CAR = "svea7"
KEYS = {name: Ed25519PrivateKey.from_private_bytes(bytes([i]) * 32) for i, name in enumerate(("station", CAR))}
VERIFIER = Verifier({name: key.public_key() for name, key in KEYS.items()})
STATION, OTHER = (Signer(name, key) for name, key in KEYS.items())
LIMITS = Limits(speed=0.5, steering=0.5, acceleration=1.0, steering_rate=2.0)
START = 1_700_000_000 * 10**9  # ns
MS = 1_000_000  # ns


class Bench:
    """One gate, its clocks and its station."""

    def __init__(self, limits: Limits = LIMITS, signed: bool = True) -> None:
        self.wall, self.steady = START, 7
        self.gate = Gate(CAR, limits, GateClock(lambda: self.wall, lambda: self.steady), VERIFIER if signed else None)
        self.session, self.sequence = "", 0

    def wait(self, duration: int) -> None:
        """Let time pass, ns."""
        self.wall += duration
        self.steady += duration

    def send(self, role: Role, payload: bytes, signer: Signer | None = STATION) -> Reason | None:
        attachment = b"" if signer is None else signer.sign(SVEA.topic_of(CAR, role), payload)
        return self.gate.arrive(role, payload, attachment)

    def arm(self, session: str = "s1", nonce: str | None = None, armed: bool = True, age: int = 0) -> Reason | None:
        self.session = session
        shown = self.status().nonce if nonce is None else nonce
        return self.send(Role.ARM, messages.arm(self.wall - age, session, shown, armed))

    def command(
        self,
        steering: float = 0.1,
        speed: float = 0.2,
        age: int = 0,
        sequence: int | None = None,
        signer: Any = STATION,
    ) -> Reason | None:
        """Send a command of the armed session, by default the next one."""
        if sequence is None:
            self.sequence = sequence = self.sequence + 1
        payload = messages.command(self.wall - age, self.session, sequence, steering, speed)
        return self.send(Role.COMMAND, payload, signer)

    def stop(self, value: bool = True) -> Reason | None:
        return self.send(Role.STOP, messages.stop(value), None)

    def status(self) -> Any:
        return decode(self.gate.status(), SVEA.topics[Role.GATE].type)

    def tick(self) -> MotionCommand:
        """Return the car's command after one more period."""
        self.wait(PERIOD)
        payload = self.gate.tick()
        assert stamp_of(decode(payload, SVEA.topics[Role.MANUAL].type)) == self.wall
        return read_drive(payload, SVEA.command)

    def drive(self, ticks: int, **fields: Any) -> MotionCommand:
        """Return the car's command after some commands, one per tick."""
        output = MotionCommand()
        for _ in range(ticks):
            assert self.command(**fields) is None
            output = self.tick()
        return output


Message = tuple[Role, bytes, bytes]
NO_ANGLES = (math.nan, math.inf, -math.inf, 1e30, -1e30, 0.6, -0.6)
ROLES = (Role.COMMAND, Role.ARM)


def messages_of_strangers(
    random: Random, station: Signer, stranger: Signer, session: str, last: int, now: Callable[[], int]
) -> Iterator[Message]:
    """Yield bad messages for ever.

    Args:
        random: draws them.
        station: signs what is replayed, stale or beyond the limits: genuine, but not to be accepted.
        stranger: signs as another identity that is known, and as the station with its own key.
        session: that is armed.
        last: sequence number of the last command that has been accepted.
        now: wall clock, ns.
    """
    forger = Signer(station.identity, stranger._key)
    unknown = Signer("mallory", stranger._key)

    def signed(role: Role, payload: bytes, signer: Signer = station) -> Message:
        return role, payload, signer.sign(SVEA.topic_of(CAR, role), payload)

    def command(stamp: int = 0, sequence: int = 0, session: str = session, steering: float = 0.1) -> bytes:
        return messages.command(now() + stamp, session, last + 1 + sequence, steering, 0.3)

    fresh = command()
    good = station.sign(SVEA.topic_of(CAR, Role.COMMAND), command(sequence=1))  # of another message
    stale = [signed(Role.COMMAND, command(-random.randrange(200 * MS, 10**12))) for _ in range(50)]
    ahead = [signed(Role.COMMAND, command(random.randrange(10**11, 10**13), 10**6)) for _ in range(50)]
    replayed = [signed(Role.COMMAND, command(0, -1 - random.randrange(last + 1))) for _ in range(50)]
    elsewhere = [signed(Role.COMMAND, command(session=name)) for name in ("", "s", session + "0", "\0")]
    while True:
        role = random.choice(ROLES)
        cheap = (
            lambda role=role: (role, random.randbytes(random.randrange(200)), good),
            lambda role=role: (role, b"\0\1\0\0" + random.randbytes(random.randrange(200)), good),
            lambda: (Role.COMMAND, fresh[: random.randrange(len(fresh))], good),
            lambda role=role: (role, random.randbytes(random.randrange(513, 70_000)), random.randbytes(80)),
            lambda: random.choice(stale),
            lambda: random.choice(ahead),
            lambda: random.choice(replayed),
            lambda: random.choice(elsewhere),
        )
        dear = (
            lambda: signed(Role.COMMAND, command(), random.choice((stranger, forger, unknown))),
            lambda: (Role.COMMAND, command(), random.choice((b"", good, random.randbytes(random.randrange(120))))),
            lambda: signed(Role.COMMAND, command(steering=random.choice(NO_ANGLES))),
            lambda: signed(Role.ARM, messages.arm(now(), session, random.randbytes(8).hex())),
            lambda: signed(Role.ARM, messages.arm(now(), session, "", random.random() < 0.5), forger),
            lambda: signed(Role.ARM, command()),
        )
        yield random.choice(dear)() if random.random() < 0.15 else random.choice(cheap)()
