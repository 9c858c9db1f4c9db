"""`coopenv watch | play`: look at an agent, or drive by hand."""

from pathlib import Path
from typing import Annotated

import typer

from coopenv.base.errors import CoopenvError
from coopenv.cli import complete, options


def watch(
    agent: Annotated[
        str,
        typer.Argument(
            metavar="AGENT",
            help="Name of an agent, its folder, or where its class stands, mine.py:Mine or package.module:Mine.",
            autocompletion=complete.agents,
            callback=complete.known_agents,
        ),
    ],
    environment: Annotated[
        str | None,
        typer.Option(
            "--env",
            help="Name or TOML file of the environment (default: the first that the agent was made for).",
            **complete.ENVIRONMENT,
        ),
    ] = None,
    seed: options.Seed = 0,
    overrides: options.Overrides = None,
    speed: Annotated[float, typer.Option(min=0.01, help="Times real time.")] = 1.0,
    out: Annotated[Path | None, typer.Option(help="Folder for a film, in place of the window.")] = None,
) -> None:
    """Watch an agent drive, in a window or as a film."""
    from coopenv.policies import find_agent

    found, log = find_agent(agent), options.console(stderr=True)
    name = environment or next(iter(found.environments), None)
    if name is None:
        raise CoopenvError(f"{agent} does not say for which environment it was made; name one with --env")
    scenario = options.load(name, options.parse_overrides(overrides))
    from coopenv.runs import live

    policy = found.policy(scenario)
    if out is not None:
        stage = live.film(scenario, policy, seed, out, log)
    else:
        stage = live.watch(scenario, policy, seed, log, clock=live.Clock(speed))
    for line in stage.outcomes():
        options.console().print(line, soft_wrap=True)


def play(
    environment: options.Environment,
    vehicle: Annotated[str | None, typer.Option(help="Name of the vehicle to drive (default: the first).")] = None,
    others: Annotated[
        str | None,
        typer.Option(
            help="Policy of the other vehicles (default: route_follower where it can drive).",
            **complete.POLICY,
        ),
    ] = None,
    seed: options.Seed = 0,
    overrides: options.Overrides = None,
) -> None:
    """Drive a vehicle by the arrow keys."""
    scenario, log = options.load(environment, options.parse_overrides(overrides)), options.console(stderr=True)
    from coopenv.runs import live

    index = live.vehicle_index(scenario, vehicle)
    policy = live.others_of(scenario, Path(environment).stem, others, seed)
    stage = live.drive_by_hand(scenario, index, policy, seed, log)
    options.console().print(stage.outcomes()[index], soft_wrap=True)
