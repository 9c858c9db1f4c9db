"""A gate with clocks that stand still until they are told, and a station that signs."""

from __future__ import annotations

from typing import Any

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from coopenv.cars.codec import decode, stamp_of
from coopenv.cars.gate.core import PERIOD, Gate, GateClock, Reason, read_drive
from coopenv.cars.keys import Signer, Verifier
from coopenv.cars.profile import SVEA, Limits, MotionCommand, Role
from tests.cars.link.gate import messages

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
        """Return what the car is told after one more period."""
        self.wait(PERIOD)
        payload = self.gate.tick()
        assert stamp_of(decode(payload, SVEA.topics[Role.MANUAL].type)) == self.wall
        return read_drive(payload, SVEA.command)

    def drive(self, ticks: int, **fields: Any) -> MotionCommand:
        """Return what the car is told after some commands, one per tick."""
        told = MotionCommand()
        for _ in range(ticks):
            assert self.command(**fields) is None
            told = self.tick()
        return told
