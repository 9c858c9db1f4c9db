"""`coopenv list | describe | schema`: what there is."""

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
    Source,
    Variant,
    console,
    load,
    open_source,
    parse_overrides,
)


class Kind(StrEnum):
    """What `coopenv list` lists."""

    ENVS = "envs"
    OBSERVERS = "observers"
    AGENTS = "agents"


def list_command(
    kind: Annotated[Kind, typer.Argument(help="What to list.")] = Kind.ENVS, as_json: AsJson = False
) -> None:
    """List environments, observers or agents."""
    from coopenv.jsonable import json_text
    from coopenv.runs import listing
    from coopenv.shipped import list_envs

    if kind is Kind.ENVS:
        rows = listing.environment_rows({name: load(name, {}) for name in list_envs()})
    else:
        rows = listing.observer_rows() if kind is Kind.OBSERVERS else listing.agent_rows()
    if as_json:
        sys.stdout.write(json_text(rows))
    else:
        console().print(listing.list_table(rows, listing.COLUMNS[kind]))


def describe(
    environment: Source,
    overrides: Overrides = None,
    everything: Annotated[bool, typer.Option("--all", help="Also every vehicle, setting and field.")] = False,
    as_json: AsJson = False,
    data: DataFolder = None,
    variant: Variant = None,
) -> None:
    """Say what an environment is: vehicles, sensors, observer."""
    from coopenv.jsonable import json_text
    from coopenv.runs.describe import describe_scenario
    from coopenv.runs.summary import document, summary

    name = Path(environment).stem
    backend = open_source(environment, parse_overrides(overrides), data, variant)
    scenario, recorded = backend.scenario, backend.capabilities.recorded
    if as_json:
        sys.stdout.write(json_text(document(name, scenario)))
        return
    out = console()
    for part in describe_scenario(scenario) if everything else summary(name, scenario, recorded):
        out.print(part)
    if not everything:
        out.print("\nMore: --all (every vehicle, setting and field), --json (all of it as data).")


def schema(
    out: Annotated[Path | None, typer.Option(help="File to write (default: standard output).")] = None,
) -> None:
    """Write the JSON schema of scenario files, for editors."""
    from coopenv.files import replace_text
    from coopenv.scenario.json_schema import schema_text

    if out is None:
        sys.stdout.write(schema_text())
        return
    replace_text(out, schema_text())
