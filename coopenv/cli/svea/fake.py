"""`coopenv svea fake`: a fake car, one process each."""

import gc
import sys
import threading
from pathlib import Path
from typing import Annotated

import typer

from coopenv.cli import options


def fake(
    deployment: Annotated[Path, typer.Argument(metavar="DEPLOYMENT.toml", help="The fleet that it belongs to.")],
    car: Annotated[str, typer.Option(help="Name of the car, as in the deployment.")],
    seed: options.Seed = 0,
    fault: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KIND[=VALUE][@START[+DURATION]]",
            help="What goes wrong, from when on and for how long in s, e.g. loss=0.2@5+10. Kinds: freeze, kill, loss, "
            "delay, clock_offset, clock_drift, false_blocks, duplicate_blocks, swapped_signatures. Repeatable.",
        ),
    ] = None,
    connect: options.Connect = None,
    gate: Annotated[
        bool, typer.Option(help="Whether commands come through a gate of its own; else it obeys ManualControl.")
    ] = True,
    station: options.Station = None,
) -> None:
    """Let a fake car drive, see and send until it is interrupted; it says so when it can be seen."""
    from coopenv.base import interrupts
    from coopenv.cars.deployment import load_deployment
    from coopenv.cars.fake.faults import parse_fault
    from coopenv.cars.fake.fleet import prepare_fake, run
    from coopenv.cars.transport.open import open_transport

    faults = [parse_fault(text) for text in fault or ()]
    make = prepare_fake(deployment, car, gate, station)
    transport = open_transport(load_deployment(deployment, connect))

    def complain(line: str) -> None:
        print(line, file=sys.stderr, flush=True)

    try:
        made = make(transport, seed=seed, faults=faults, complain=complain)
        gc.freeze()  # what is there stays, and need not be looked through again and again
        interrupts.note(f"{car} is gone")
        print(f"{car}: fake ready", flush=True)
        run(made, threading.Event())
    finally:
        transport.close()
