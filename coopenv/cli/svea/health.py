"""`coopenv svea health`: whether the gate of a car speaks; for people and for health checks of containers."""

from pathlib import Path
from typing import Annotated

import typer

from coopenv.cli import options


def health(
    deployment: Annotated[Path, typer.Argument(metavar="DEPLOYMENT.toml", help="The fleet that the car belongs to.")],
    car: Annotated[str, typer.Option(help="Name of the car, as in the deployment.")],
    connect: options.Connect = None,
    patience: Annotated[float, typer.Option(min=0.1, help="s to wait for it.")] = 2.0,
) -> None:
    """Wait for the next word of a car's gate and print it; the exit status is 2 where none comes."""
    from queue import Empty, SimpleQueue

    from coopenv.errors import CoopenvError
    from coopenv.svea.codec import decode
    from coopenv.svea.deployment import load_deployment
    from coopenv.svea.topics import TOPICS, Role, topic_of
    from coopenv.svea.transport.base import Arrival
    from coopenv.svea.transport.open import open_transport

    fleet = load_deployment(deployment, connect)
    topic, heard = topic_of(fleet.car(car).name, Role.GATE), SimpleQueue[Arrival]()
    transport = open_transport(fleet)
    try:
        transport.subscribe(topic, heard.put)
        status = decode(heard.get(timeout=patience).payload, TOPICS[Role.GATE].type)
    except Empty:
        raise CoopenvError(f"{car}: its gate has said nothing for {patience:g} s on {topic}") from None
    finally:
        transport.close()
    refused = sum(int(count) for count in status.counts)
    print(f"{car}: gate {status.state}, {status.accepted} commands accepted, {refused} messages refused")
