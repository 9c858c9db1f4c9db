"""`coopenv svea router`: what the cars and the station connect to."""

import threading
from typing import Annotated

import typer


def router(
    listen: Annotated[
        list[str] | None,
        typer.Option(help="Endpoint to listen at (default: tcp/127.0.0.1:7447, this computer alone). Repeatable."),
    ] = None,
) -> None:
    """Run a Zenoh router until it is interrupted; it says so when it can be reached."""
    from coopenv.base import interrupts
    from coopenv.cars.transport.zenoh import open_zenoh

    endpoints = listen or ["tcp/127.0.0.1:7447"]
    transport = open_zenoh("router", listen=endpoints)
    try:
        interrupts.note("the router is gone")
        print(f"router ready at {', '.join(endpoints)}", flush=True)
        threading.Event().wait()
    finally:
        transport.close()
