"""`coopenv list | describe | schema`: what there is."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from coopenv.cli.options import Environment, Overrides, console, load, parse_overrides


def list_command() -> None:
    """List the environments that ship with coopenv."""
    from coopenv.runs.describe import environment_table
    from coopenv.shipped import list_envs

    out = console()
    out.print(environment_table({name: load(name, {}) for name in list_envs()}))


def describe(environment: Environment, overrides: Overrides = None) -> None:
    """Say what an environment is: vehicles, sensors, observer."""
    from coopenv.runs.describe import describe_scenario

    out = console()
    for part in describe_scenario(load(environment, parse_overrides(overrides))):
        out.print(part)


def schema(
    out: Annotated[Path | None, typer.Option(help="File to write (default: standard output).")] = None,
) -> None:
    """Write the JSON schema of scenario files, for editors."""
    from coopenv.files import replacing_file
    from coopenv.scenario.json_schema import schema_text

    if out is None:
        print(schema_text(), end="")
        return
    with replacing_file(out) as new:
        new.write_text(schema_text(), encoding="utf-8")
