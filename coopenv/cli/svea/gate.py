"""`coopenv svea gate`: what stands between the network and the wheels, on the car's own computer."""

import os
import signal
import sys
from pathlib import Path
from typing import Annotated

import typer

from coopenv.cli import options

Speed = typer.Option(help="Most m/s [default: 0.5].", show_default=False)
Angle = typer.Option(help="Most rad of steering [default: 0.5236].", show_default=False)
Acceleration = typer.Option(help="Most m/s^2, either way [default: 1].", show_default=False)
Rate = typer.Option(help="Most rad/s of steering [default: 2].", show_default=False)


def gate(
    car: Annotated[str, typer.Option(help="Name of this car, as in its topics: svea7.")],
    deployment: Annotated[
        Path | None,
        typer.Argument(metavar="[DEPLOYMENT.toml]", help="Deployment with [gate], keys and limits; options win."),
    ] = None,
    connect: options.GateConnect = None,
    off_board: options.OffBoard = False,
    keys: Annotated[
        Path | None, typer.Option(help="Folder with CAR.pem and public.toml of `coopenv svea keys`.")
    ] = None,
    station: options.Station = None,
    max_speed: Annotated[float | None, Speed] = None,
    max_steering: Annotated[float | None, Angle] = None,
    max_acceleration: Annotated[float | None, Acceleration] = None,
    max_steering_rate: Annotated[float | None, Rate] = None,
    reverse: Annotated[bool | None, typer.Option("--reverse", help="Let the car drive backwards.")] = None,
) -> None:
    """Pass on commands that are fresh, signed, in order and inside the limits; else keep the car neutral.

    Runs on the car until it is interrupted; the car then gets neutral. It starts disarmed, and the station arms it for
    a session. It connects to the car's own router, so that neutral gets to the wheels when the radio is gone. Without a
    valid command for 0.2 s the car gets neutral until there is a newer one. A stop, from anybody, holds until the next
    arming. Clocks of car and station must agree to 50 ms (chrony). What the gate rejects is counted in its status,
    fleet/CAR/coopenv/gate.

    Limits beyond those of the make are refused: for SVEA 1.53 m/s, 0.5236 rad, 2 m/s^2 and 4 rad/s.
    """
    from coopenv.base import interrupts
    from coopenv.cars.gate.core import Gate
    from coopenv.cars.gate.process import CLOCK, GateSettings, Link, run

    bounds = {"speed": max_speed, "steering": max_steering, "acceleration": max_acceleration}
    given = GateSettings.of(car, deployment).changed(
        connect=connect and (connect,),
        keys=keys,
        station=station,
        limits={**bounds, "steering_rate": max_steering_rate, "reverse": reverse},
    )
    given.check_place(off_board)
    signer, verifier = given.identities()
    if verifier is None:
        print("warning: without --keys whoever reaches the router can drive this car", file=sys.stderr)
    transport = given.open()
    try:
        decides = Gate(car, given.limits, CLOCK, verifier, given.station, given.profile)
        link = Link(decides, car, transport, signer, given.profile)
        interrupts.note(f"{car} is in neutral")
        if hasattr(signal, "SIGHUP"):  # a terminal that is closed ends the gate, too, but not before the car stands
            signal.signal(signal.SIGHUP, lambda *_: os.kill(os.getpid(), signal.SIGTERM))
        print(f"{car}: gate ready at {', '.join(given.connect)}", flush=True)
        run(link)
    finally:
        transport.close()
