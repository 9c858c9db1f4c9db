"""`coopenv svea health`: whether the gate of a car speaks; for people and for health checks of containers."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from coopenv.cli import options

if TYPE_CHECKING:
    from coopenv.cars.transport.base import Transport

MOST_WAITING = 16
"""Messages that are kept until they are looked at; a gate says five a second."""


def health(
    deployment: Annotated[Path, typer.Argument(metavar="DEPLOYMENT.toml", help="The fleet that the car belongs to.")],
    car: Annotated[str, typer.Option(help="Name of the car, as in the deployment.")],
    connect: options.GateConnect = None,
    off_board: options.OffBoard = False,
    patience: Annotated[float, typer.Option(min=0.1, help="s to wait for it.")] = 2.0,
) -> None:
    """Wait for the next word of a car's gate and print it; the exit status is 2 where none comes.

    On the car it connects to where the gate does. From elsewhere: --connect ROUTER --off-board.
    """
    from coopenv.base.errors import CoopenvError
    from coopenv.cars.gate.process import GateSettings
    from coopenv.cars.profile import Role

    given = GateSettings.of(car, deployment).changed({}, connect=connect and (connect,))
    given.check_place(off_board)
    topic, transport = given.profile.topic_of(given.car, Role.GATE), given.open()
    try:
        status = next_status(transport, topic, patience)
    finally:
        transport.close()
    if status is None:
        raise CoopenvError(f"{car}: its gate has said nothing for {patience:g} s on {topic}")
    refused = sum(int(count) for count in status.counts)
    print(f"{car}: gate {status.state}, {status.accepted} commands accepted, {refused} messages refused")


def next_status(transport: "Transport", topic: str, patience: float) -> Any | None:
    """Return the next message of a gate's topic that is one (None: none within s); whatever else comes is dropped."""
    import time
    from contextlib import suppress
    from queue import Empty, Full, Queue

    from coopenv.base.errors import CoopenvError
    from coopenv.cars.codec import MOST_BYTES, decode
    from coopenv.cars.profile import GATE_TYPES, Role
    from coopenv.cars.transport.base import Arrival

    heard, until = Queue[bytes](MOST_WAITING), time.monotonic() + patience

    def keep(arrival: Arrival) -> None:
        if len(arrival.payload) <= MOST_BYTES:
            with suppress(Full):
                heard.put_nowait(arrival.payload)

    transport.subscribe(topic, keep)
    with suppress(Empty):
        while True:
            payload = heard.get(timeout=max(until - time.monotonic(), 0.0))
            with suppress(CoopenvError):
                return decode(payload, GATE_TYPES[Role.GATE])
    return None
