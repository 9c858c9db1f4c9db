"""`coopenv svea demo`: fake cars, a router and the process that drives them, on this computer."""

from pathlib import Path
from typing import Annotated

import typer

from coopenv.cli import options
from coopenv.cli.svea.run import STOPPED


def demo(
    environment: Annotated[
        str, typer.Option(help="The experiment: svea_overtaking or svea_crossing.")
    ] = "svea_overtaking",
    fleet: Annotated[
        Path | None, typer.Option(help="Or a deployment file of your own, whose cars are fakes (fakes = true).")
    ] = None,
    port: Annotated[
        int | None, typer.Option(min=1, max=65535, help="Port of the router on this computer (default: a free one).")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder of the results (default: out/NAME of environment or file); the drive is beside it."),
    ] = None,
    policy: options.PolicyName = "route_follower",
    seed: options.Seed = 0,
    seconds: Annotated[
        float, typer.Option(min=0.0, help="Go on with further seeds until the cars have driven so long, s.")
    ] = 0.0,
    beside: Annotated[
        bool, typer.Option("--beside", help="Simulate the same seeds, too, and print both side by side.")
    ] = False,
    overrides: options.Overrides = None,
) -> None:
    """Let fake cars drive an experiment in real time: table, figures, and a drive that can be run again.

    A router and a process per car run on this computer's loopback for as long as it takes, half a minute. The first
    time kernels are compiled, which takes a minute or two more. The exit status is 3 where the watchdog stopped the
    cars.
    """
    from coopenv.runs.demo import Demo, run_demo

    name = environment if fleet is None else fleet.stem
    changes, folder = options.parse_overrides(overrides), out or Path("out") / name
    chosen = Demo(name, folder, policy, seed, changes, seconds, beside, fleet)
    with options.warned():
        if not run_demo(chosen, port, options.console(stderr=True), options.console()):
            raise typer.Exit(STOPPED)
