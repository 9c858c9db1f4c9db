"""`coopenv run | record`: simulate an environment, or keep what vehicles sense."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from coopenv.cli import complete
from coopenv.cli.options import (
    DataFolder,
    Environment,
    Overrides,
    PolicyName,
    Seed,
    SteadyFrom,
    console,
    load,
    parse_overrides,
    warned,
)
from coopenv.errors import CoopenvError, OutputError


def run(
    environment: Environment,
    seed: Seed = 0,
    overrides: Overrides = None,
    steps: Annotated[int | None, typer.Option(min=1, help="Decisions to run (default: up to the horizon).")] = None,
    out: Annotated[Path | None, typer.Option(help="Folder of the results (default: out/ENV).")] = None,
    device: Annotated[str, typer.Option(help="Device that computes: cpu, cuda, cuda:0, ...")] = "cpu",
    dtype: Annotated[str, typer.Option(help="Precision: float32 or float64.")] = "float64",
    policy: PolicyName = "zero",
    steady_from: SteadyFrom = None,
    video: Annotated[bool, typer.Option("--video", help="Also write a video of the top view.")] = False,
) -> None:
    """Run an environment; write metrics, arrays and figures."""
    parsed = parse_overrides(overrides)
    scenario = load(environment, parsed)
    from coopenv.runs.command import RunRequest, execute

    name = Path(environment).stem
    request = RunRequest(
        name=name,
        scenario=scenario,
        folder=out if out is not None else Path("out") / name,
        overrides=parsed,
        seed=seed,
        steps=steps,
        device=device,
        dtype=dtype,
        policy=policy,
        steady_from=steady_from,
        video=video,
    )
    execute(request, console(), console(stderr=True))


def record_command(
    environment: Annotated[
        str,
        typer.Argument(
            metavar="ENV|DATASET",
            help="Environment, TOML file, or a data set such as mrclam_6.",
            autocompletion=complete.environments,
        ),
    ],
    out: Annotated[Path, typer.Option(help="MCAP file to write.")],
    seed: Seed = 0,
    policy: PolicyName = "zero",
    overrides: Overrides = None,
    data: DataFolder = None,
    variant: Annotated[str | None, typer.Option(help="Variant of a data set, e.g. landmarks or blind.")] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace a file that is there.")] = False,
) -> None:
    """Write what vehicles sense to an MCAP file.

    The file holds every tick; Foxglove opens it and coopenv replays it.
    """
    from coopenv.backends.mcap import check_target, write_recording
    from coopenv.backends.replay import is_recorded
    from coopenv.runs.log import read_recorded, simulate

    check_target(out)
    if out.exists() and not force:
        raise OutputError(f"{out}: exists already; --force replaces it")
    parsed = parse_overrides(overrides)
    if is_recorded(environment):
        asked = {"--set": parsed, "--seed": seed, "--policy": policy if policy != "zero" else None}
        with warned():
            recording = read_recorded(
                environment, data, variant, {name: value for name, value in asked.items() if value}
            )
    else:
        for option, value in (("--data", data), ("--variant", variant)):
            if value is not None:
                raise CoopenvError(f"{option} {value}: is for recorded data, {environment} is simulated")
        recording = simulate(load(environment, parsed), seed, policy)
    write_recording(recording, out)
    console().print(
        f"{out}: {len(recording.setups)} vehicles, {recording.ticks} ticks, {recording.t[-1]:g} s", soft_wrap=True
    )
