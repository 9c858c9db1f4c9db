"""`coopenv svea run`: observe cars, or drive them."""

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from coopenv.base.errors import CoopenvError
from coopenv.cli import options

STOPPED = 3
"""Status of a run that was stopped, by whom or what ever."""


def run(
    config: Annotated[Path, typer.Argument(metavar="DEPLOYMENT.toml", help="Which cars, and how they are reached.")],
    car: Annotated[
        str | None,
        typer.Option(help="Estimate and drive this car alone and hear the others (default: all, as an edge server)."),
    ] = None,
    arm: Annotated[
        bool, typer.Option("--arm", help="Let the cars drive. Without it everything happens but that.")
    ] = False,
    release: Annotated[
        bool, typer.Option("--release", help="With --arm: also cars that somebody has stopped. Know why, first.")
    ] = False,
    policy: options.PolicyName = "zero",
    seed: options.Seed = 0,
    steps: Annotated[int | None, typer.Option(min=1, help="Decisions to run (default: up to the horizon).")] = None,
    connect: options.Connect = None,
    record: Annotated[
        Path | None, typer.Option(help="MCAP file for every message that comes or goes; coopenv run replays it.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder of the results (default: out/DEPLOYMENT).")] = None,
    overrides: options.Overrides = None,
    steady_from: Annotated[
        float, typer.Option(min=0.0, help="RMSE and NEES count from this time on, s: cars know their places by then.")
    ] = 2.0,
    no_figures: Annotated[bool, typer.Option("--no-figures", help="Draw no figures.")] = False,
    as_json: options.AsJson = False,
) -> None:
    """Run an environment on cars: observers estimate, a policy drives, tables and figures follow.

    Without --arm no command is sent: run it beside the car that somebody else drives.
    """
    from coopenv.base.interrupts import also_kept
    from coopenv.cars.backend.opening import open_svea
    from coopenv.runs.command import NoTruthError, execute, report
    from coopenv.runs.demo import kept_drive, links_line, links_report, truth_report
    from coopenv.runs.rollouts import Rollout

    changes, log = options.parse_overrides(overrides), options.console(stderr=True)
    with options.warned():
        backend = open_svea(config, None, changes, car, record, connect=connect)
    also_kept(partial(kept_drive, record, backend))
    try:
        wishes = {"arm": arm, "release": release}
        rollout = Rollout(backend.scenario, seed, steps, policy=policy, backend=backend, options=wishes)
        folder = out or Path("out") / config.stem
        figures = None if no_figures else "png"
        watched = partial(links_line, backend)
        result = execute(config.stem, rollout, folder, log, changes, steady_from, figures, False, watched)
    except NoTruthError:
        raise CoopenvError(truth_report(backend)) from None
    finally:
        backend.close()
    if as_json:
        options.print_json(result)
    else:
        report(rollout, result, folder, options.console())
        links_report(backend, options.console())
    if backend.watchdog.trip is not None:
        raise typer.Exit(STOPPED)
