"""`coopenv svea fake`: a fake car, one process each."""

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
    gate: Annotated[
        bool, typer.Option(help="Whether commands come through a gate of its own; else it obeys ManualControl.")
    ] = True,
) -> None:
    """Let a fake car drive, see and send until it is interrupted; it prints `ready` when it can be seen."""
    from coopenv.fake.car import Fake
    from coopenv.fake.faults import parse_fault
    from coopenv.fake.process import binding_of, run
    from coopenv.svea.deployment import load_deployment

    faults = [parse_fault(text) for text in fault or ()]
    fleet = load_deployment(deployment)
    binding = binding_of(fleet, car)
    transport = open_transport(fleet)
    try:
        made = Fake(
            fleet,
            binding,
            car,
            transport,
            seed=seed,
            faults=faults,
            gate=gate,
            verifier=None,
            complain=lambda line: print(line, file=sys.stderr, flush=True),
        )
        print("ready", flush=True)
        run(made, threading.Event())
    finally:
        transport.close()
