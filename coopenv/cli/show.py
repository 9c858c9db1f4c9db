"""`coopenv list | describe | scene | schema`: what there is."""

import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from coopenv.cli import options

Kind = StrEnum("Kind", "envs observers agents variants scenes")


def list_command(
    kind: Annotated[Kind, typer.Argument(help="What to list.")] = Kind.envs, as_json: options.AsJson = False
) -> None:
    """List environments, observers, agents, variants or scenes."""
    from coopenv.runs import listing

    if kind is Kind.variants:
        from coopenv.bench.observers.sources import variant_rows

        rows = variant_rows()
    elif kind is Kind.scenes:
        from coopenv.scenario.scenes import scene_rows

        rows = scene_rows()
    else:
        makers = {
            Kind.envs: listing.environment_rows,
            Kind.observers: listing.observer_rows,
            Kind.agents: listing.agent_rows,
        }
        with options.warned():
            rows = makers[kind]()
    if as_json:
        options.print_json(rows)
    else:
        options.console().print(listing.list_table(rows, listing.COLUMNS[kind]))


def describe(
    environment: options.Source,
    overrides: options.Overrides = None,
    everything: Annotated[bool, typer.Option("--all", help="Also every vehicle, setting and field.")] = False,
    as_json: options.AsJson = False,
    data: options.DataFolder = None,
    variant: options.Variant = None,
    topics: options.TopicMap = None,
) -> None:
    """Say what an environment is: vehicles, sensors, observer."""
    from coopenv.backends.sources import is_recorded, simulation_of
    from coopenv.runs.describe import describe_scenario
    from coopenv.runs.summary import document, summary

    name, changes = Path(environment).stem, options.parse_overrides(overrides)
    if is_recorded(environment) or any(option is not None for option in (data, variant, topics)):
        backend = options.open_source(environment, changes, data, variant, topics)
        scenario, recorded = backend.scenario, backend.capabilities.recorded
    else:
        scenario, recorded = options.load(environment, changes), False
        if scenario.backend != "simulated":  # the roads of highway-env are drawn by highway-env itself
            scenario = simulation_of(scenario).scenario
    if as_json:
        options.print_json(document(name, scenario))
        return
    out = options.console()
    for part in describe_scenario(scenario) if everything else summary(name, scenario, recorded):
        out.print(part)
    if not everything:
        out.print("More: --all (every vehicle, setting and field), --json (all of it as data).")


def scene(
    name: Annotated[
        str,
        typer.Argument(
            metavar="SCENE",
            help="Kind of scene and how many vehicles, such as lane:20, lane:8,seen=2 or random:12,seed=3.",
        ),
    ],
    out: Annotated[Path | None, typer.Option(help="File to write (default: standard output).")] = None,
) -> None:
    """Write a scene that is made to measure as a scenario file, to be kept or changed.

    Scenes stand wherever an environment does: coopenv bench observers lane:20. `coopenv list scenes` lists them.
    """
    from coopenv.base.files import replace_text
    from coopenv.scenario.scenes import scene_text

    text = scene_text(name)
    if out is None:
        sys.stdout.write(text)
    else:
        replace_text(out, text)


def schema(out: Annotated[Path | None, typer.Option(help="File to write (default: standard output).")] = None) -> None:
    """Write the JSON schema of scenario files, for editors."""
    from coopenv.base.files import replace_text
    from coopenv.scenario.files import schema_text

    if out is None:
        sys.stdout.write(schema_text())
    else:
        replace_text(out, schema_text())
