"""`coopenv run | record`: simulate an environment, or keep what vehicles sense."""

from __future__ import annotations

import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from coopenv.cli.options import (
    AsJson,
    DataFolder,
    Overrides,
    PolicyName,
    Seed,
    Source,
    SteadyFrom,
    Variant,
    console,
    load,
    open_source,
    parse_overrides,
    warned,
)
from coopenv.errors import CoopenvError, OutputError


class FigureFormat(StrEnum):
    """Formats of figures."""

    PNG = "png"
    PDF = "pdf"
    SVG = "svg"


def run(
    environment: Source,
    seed: Seed = 0,
    overrides: Overrides = None,
    steps: Annotated[int | None, typer.Option(min=1, help="Decisions to run (default: up to the horizon).")] = None,
    out: Annotated[Path | None, typer.Option(help="Folder of the results (default: out/ENV).")] = None,
    device: Annotated[str, typer.Option(help="Device that computes: cpu, cuda, cuda:0, ...")] = "cpu",
    dtype: Annotated[str, typer.Option(help="Precision: float32 or float64.")] = "float64",
    policy: PolicyName = "zero",
    steady_from: SteadyFrom = None,
    figures: Annotated[FigureFormat, typer.Option(help="Format of the figures.")] = FigureFormat.PNG,
    no_figures: Annotated[bool, typer.Option("--no-figures", help="Draw no figures.")] = False,
    video: Annotated[bool, typer.Option("--video", help="Also write a video of the top view.")] = False,
    as_json: AsJson = False,
    data: DataFolder = None,
    variant: Variant = None,
) -> None:
    """Run an environment; write metrics, arrays and figures."""
    from coopenv.jsonable import json_text
    from coopenv.runs.command import RunRequest, execute, report

    parsed = parse_overrides(overrides)
    refuse_for_recordings(environment, seed=seed, policy=policy)
    name = Path(environment).stem
    request = RunRequest(
        name=name,
        backend=open_source(environment, parsed, data, variant),
        folder=out if out is not None else Path("out") / name,
        overrides=parsed,
        seed=seed,
        steps=steps,
        device=device,
        dtype=dtype,
        policy=policy,
        steady_from=steady_from,
        figures=None if no_figures else figures.value,
        video=video,
    )
    result = execute(request, console(stderr=True))
    if as_json:
        sys.stdout.write(json_text(result.document()))
    else:
        report(request, result, console())


def refuse_for_recordings(environment: str, seed: int, policy: str) -> None:
    """Refuse options that only a simulation knows.

    Raises:
        CoopenvError: one was given for a recording.
    """
    from coopenv.backends.sources import is_recorded

    for option, value in (("--seed", seed), ("--policy", policy)):
        if is_recorded(environment) and value not in (0, "zero"):
            raise CoopenvError(f"{option}: is for a simulation, {environment} is recorded")


def record_command(
    environment: Source,
    out: Annotated[Path, typer.Option(help="MCAP file to write.")],
    seed: Seed = 0,
    policy: PolicyName = "zero",
    overrides: Overrides = None,
    data: DataFolder = None,
    variant: Variant = None,
    force: Annotated[bool, typer.Option("--force", help="Replace a file that is there.")] = False,
) -> None:
    """Write what vehicles sense to an MCAP file.

    The file holds every tick; Foxglove opens it and coopenv replays it.
    """
    from coopenv.backends.mcap import check_target, write_recording
    from coopenv.backends.sources import is_recorded, open_recording
    from coopenv.runs.recorder import record

    check_target(out)
    if out.exists() and not force:
        raise OutputError(f"{out}: exists already; --force replaces it")
    parsed = parse_overrides(overrides)
    if is_recorded(environment):
        refuse_for_recordings(environment, seed, policy)
        if parsed:
            raise CoopenvError(f"--set: is for a simulation, {environment} is recorded")
        with warned():
            recording = open_recording(environment, data, variant)
    else:
        for option, value in (("--data", data), ("--variant", variant)):
            if value is not None:
                raise CoopenvError(f"{option} {value}: is for recorded data, {environment} is simulated")
        recording = record(load(environment, parsed), seed, policy)
    write_recording(recording, out)
    console().print(
        f"{out}: {len(recording.setups)} vehicles, {recording.ticks} ticks, {recording.t[-1]:g} s", soft_wrap=True
    )
