"""Messages to a gate that are none of its station's, stale, replayed or nonsense; none may be accepted."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from random import Random

from coopenv.cars.keys import Signer
from coopenv.cars.profile import SVEA, Role
from tests.cars.link.gate import messages
from tests.cars.link.gate.bench import CAR, MS

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
