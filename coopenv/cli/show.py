"""`coopenv list | describe | scene | schema`: what there is."""

import sys
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from coopenv.base.errors import CoopenvError
from coopenv.cli import options

if TYPE_CHECKING:
    from coopenv.runs.console import Progress

Kind = StrEnum("Kind", "envs observers agents variants scenes")


def list_command(
    kind: Annotated[Kind, typer.Argument(help="What to list.")] = Kind.envs, as_json: options.AsJson = False
) -> None:
    """List environments, observers, agents, variants or scenes."""
    from coopenv.runs import summary

    if kind is Kind.variants:
        from coopenv.bench.observers.faults import variant_rows

        rows = variant_rows()
    elif kind is Kind.scenes:
        from coopenv.scenario.scenes import scene_rows

        rows = scene_rows()
    else:
        makers = {
            Kind.envs: summary.environment_rows,
            Kind.observers: summary.observer_rows,
            Kind.agents: summary.agent_rows,
        }
        with options.warned():
            rows = makers[kind]()
    if as_json:
        options.print_json(rows)
    else:
        options.console().print(summary.list_table(rows, summary.COLUMNS[kind]))


@dataclass(frozen=True, kw_only=True)
class DescribeOptions(options.SourceOptions):
    """Options of `coopenv describe`."""

    everything: Annotated[bool, typer.Option("--all", help="Also every vehicle, setting and field.")] = False
    as_json: options.AsJson = False


@options.command
def describe(given: DescribeOptions) -> None:
    """Print a summary of an environment: vehicles, sensors, observer."""
    from coopenv.backends.sources import is_recorded, simulation_of
    from coopenv.runs.summary import describe_scenario, document, summary

    name = Path(given.environment).stem
    if is_recorded(given.environment) or any((given.data, given.variant, given.topics)):
        backend = given.open()
        scenario, recorded = backend.scenario, backend.capabilities.recorded
    else:
        scenario, recorded = options.load(given.environment, given.changes), False
        if scenario.backend != "simulated":  # the roads of highway-env are drawn by highway-env itself
            scenario = simulation_of(scenario).scenario
    if given.as_json:
        options.print_json(document(name, scenario))
        return
    out = options.console()
    for part in describe_scenario(scenario) if given.everything else summary(name, scenario, recorded):
        out.print(part)
    if not given.everything:
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
    """Write a parametric scene as a scenario file, to be kept or changed.

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


def page(
    environments: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="ENV...",
            help="Names of environments or TOML files.",
            show_default=False,
            autocompletion=options.environments,
            callback=options.known_environments,
        ),
    ] = None,
    everything: Annotated[bool, typer.Option("--all", help="Every environment that ships with coopenv.")] = False,
    out: Annotated[Path, typer.Option(help="Folder for ENV.md, ENV.png and ENV.webp.")] = Path("out", "pages"),
    measure: Annotated[
        bool,
        typer.Option(
            "--measure", help="Measure the value of sensing, for ENV.json; else the file that is there is shown."
        ),
    ] = False,
    film: Annotated[
        bool,
        typer.Option("--film/--no-film", help="Film an episode for ENV.webp; else the film that is there is shown."),
    ] = True,
    worlds: Annotated[int, typer.Option(min=2, max=options.MOST_WORLDS, help="Held-out worlds to measure in.")] = 256,
) -> None:
    """Write the pages of environments: description, picture, film, value of sensing."""
    from coopenv.base.installation import list_envs
    from coopenv.bench import pages
    from coopenv.bench.cards import entrants, has_value_of_sensing
    from coopenv.runs.console import Progress

    if bool(environments) == everything:
        raise CoopenvError("name environments, or give --all for those that ship with coopenv")
    names = list_envs() if everything else list(environments or ())
    stems = {Path(text).stem: text for text in names}
    if len(stems) < len(names):
        raise CoopenvError("two environments have the same name")
    scenarios = {name: options.load(text, {}) for name, text in stems.items()}
    measured = [name for name in stems if measure and (has_value_of_sensing(name) or not everything)]
    for name in measured:
        entrants(stems[name])
    pages.prepare(out, list(stems))
    log = options.console(stderr=True)
    with Progress(log, "pages", total=len(stems)) as progress:
        for number, (name, scenario) in enumerate(scenarios.items()):
            progress.update(number, name)
            if name in measured:

                def report(done: float, driver: str, number: int = number, name: str = name) -> None:
                    progress.update(number + done, f"{name}, {driver}")

                pages.write_figures(stems[name], name, scenario, out, worlds, report)
            pages.write_page(name, scenario, out, partial(_filming, progress, number, name) if film else None)
    if shipped := {name: options.load(name, {}) for name in list_envs() if (out / f"{name}.md").is_file()}:
        pages.write_index(shipped, out)
    options.console().print(f"Pages in {out}: {', '.join(f'{name}.md' for name in stems)}", soft_wrap=True)


def _filming(progress: "Progress", number: int, name: str, share: float) -> None:
    """Show the progress of an environment's film."""
    progress.update(number + share, f"{name}, film")
