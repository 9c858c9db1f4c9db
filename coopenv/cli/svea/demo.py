"""`coopenv svea demo`: fake cars, a router and the process that drives them, on this computer."""

from pathlib import Path
from typing import Annotated

import typer

from coopenv.cli import options


def demo(
    environment: Annotated[
        str, typer.Option(help="The experiment: svea_overtaking or svea_crossing.")
    ] = "svea_overtaking",
    port: Annotated[
        int | None, typer.Option(min=1, max=65535, help="Port of the router on this computer (default: a free one).")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder of the results (default: out/ENVIRONMENT); the drive is beside it.")
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
    time kernels are compiled, which takes a minute or two more.
    """
    from coopenv.runs.demo import Demo, run_demo

    changes, folder = options.parse_overrides(overrides), out or Path("out") / environment
    chosen = Demo(environment, folder, policy, seed, changes, seconds, beside)
    run_demo(chosen, port, options.console(stderr=True), options.console())
