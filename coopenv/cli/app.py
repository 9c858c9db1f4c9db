"""The command line, `coopenv COMMAND`; `coopenv --help` lists the commands.

Commands import what they need when they run, so that `--help` and completion are quick.
"""

import os
import sys
import warnings
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from coopenv.base import interrupts
from coopenv.base.errors import CoopenvError
from coopenv.base.installation import install_command
from coopenv.base.installation import version as installed_version
from coopenv.cli import commands, options
from coopenv.cli.bench import bench, bench_observers
from coopenv.cli.evaluate import evaluate
from coopenv.cli.plugins import Extended
from coopenv.cli.run import export, figures, record, run
from coopenv.cli.train import dataset, train
from coopenv.cli.view import film, view

UsageError: Any = typer.BadParameter.__base__  # raised for every mistake in the options; it has no public name
INTERRUPTED, PIPE_CLOSED = 130, 141  # exit statuses, 128 plus the number of the signal

LOOK, RUN, COMPARE, TRAIN, VIEW = "Look around", "Run and record", "Compare", "Train", "View"
"""Groups of the list of commands."""

app = typer.Typer(
    name="coopenv",
    cls=Extended,
    help="Cooperative localisation of connected vehicles.",
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)
Kind = StrEnum("Kind", "envs observers agents variants scenes sources")


@app.command("list", rich_help_panel=LOOK)
def list_command(
    kind: Annotated[Kind, typer.Argument(help="What to list.")] = Kind.envs, as_json: options.AsJson = False
) -> None:
    """List environments, observers, agents, variants, scenes or sources."""
    from coopenv.runs import summary

    if kind is Kind.variants:
        from coopenv.bench.observers.faults import variant_rows
    with warnings.catch_warnings(action="ignore"):  # those of one environment do not name it
        rows = variant_rows() if kind is Kind.variants else summary.list_rows(kind)
    if as_json:
        options.print_json(rows)
    else:
        options.console().print(summary.list_table(rows, summary.COLUMNS[kind]))


@dataclass(frozen=True, kw_only=True)
class DescribeOptions(options.SourceOptions):
    """Options of `coopenv describe`."""

    everything: Annotated[bool, typer.Option("--all", help="Also every vehicle, setting and field.")] = False
    as_json: options.AsJson = False


@app.command(rich_help_panel=LOOK)
@commands.command
def describe(given: DescribeOptions) -> None:
    """Print a summary of an environment: vehicles, sensors, observer."""
    from coopenv.runs.summary import describe_scenario, document, summary
    from coopenv.sources.registry import ENVIRONMENT, kind_of
    from coopenv.sources.sources import simulation_of

    name = Path(given.environment).stem
    if kind_of(given.environment) is not ENVIRONMENT or given.selection.given or any(given.files.values()):
        backend = given.open()
        scenario, recorded = backend.scenario, backend.capabilities.recorded
    else:
        scenario, recorded = options.load(given.environment, given.changes), False
        if scenario.cosimulator is not None and not scenario.roads:  # they are those of the program
            scenario = simulation_of(scenario).scenario
        if any(scenario.drivers):
            from coopenv.policies.loader import ScriptedVehicles

            ScriptedVehicles(scenario)  # refuses agents that cannot drive
    if given.as_json:
        options.print_json(document(name, scenario))
        return
    out = options.console()
    for part in describe_scenario(scenario) if given.everything else summary(name, scenario, recorded):
        out.print(part)
    if not given.everything:
        out.print("More: --all (every vehicle, setting and field), --json (all of it as data).")


@app.command(rich_help_panel=LOOK)
def examples(
    folder: Annotated[Path, typer.Argument(help="Folder to write, beside other files if it exists.")] = Path(
        "examples"
    ),
) -> None:
    """Copy the examples: programs, scenarios, fleets of cars and ROS bags."""
    from coopenv.base.installation import copy_examples

    options.console().print(f"{copy_examples(folder)}: own_observer.py, bags, fleet and more", soft_wrap=True)


@app.command(rich_help_panel=LOOK)
def scene(
    name: Annotated[
        str,
        typer.Argument(
            metavar="SCENE",
            help="Kind of scene and how many vehicles, such as lane:20, lane:8,seen=2 or random:12,seed=3.",
        ),
    ],
    out: options.TextFile = None,
) -> None:
    """Write a parametric scene as a scenario file, to be kept or changed.

    Scenes stand wherever an environment does: coopenv bench observers lane:20. `coopenv list scenes` lists them.
    """
    from coopenv.scenario.scenes import scene_text

    options.write_text(scene_text(name), out)


@app.command(rich_help_panel=LOOK)
def schema(out: options.TextFile = None) -> None:
    """Write the JSON schema of scenario files, for editors."""
    from coopenv.scenario.files import schema_text

    options.write_text(schema_text(), out)


app.command(rich_help_panel=RUN)(run)
app.command(rich_help_panel=RUN)(record)
app.command(rich_help_panel=RUN)(export)
app.command(rich_help_panel=RUN)(figures)
app.add_typer(bench, name="bench", rich_help_panel=COMPARE)
app.command("compare", hidden=True)(bench_observers)  # its name in Python
app.command(rich_help_panel=COMPARE)(evaluate)
app.command(rich_help_panel=TRAIN)(train)
app.command(rich_help_panel=TRAIN)(dataset)
for command in (view, film):
    app.command(rich_help_panel=VIEW)(command)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status.

    It is 0, 2 after a mistake in the input or a result that cannot be written, 130 after Ctrl-C, 141 if the output is
    closed, and 143 after SIGTERM.
    """
    try:
        with options.warned():
            status = app(args=arguments, standalone_mode=False)
        if sys.stdout is not None:
            sys.stdout.flush()
    except BaseException as error:
        status = failure_status(error)
    if interrupts.received() or status == INTERRUPTED:
        return interrupts.report()
    return status if isinstance(status, int) else 0


def failure_status(error: BaseException) -> int:
    """Print one line for a failure that is the user's or the system's and return the exit status.

    Raises:
        BaseException: the error itself, which is a defect of the program.
    """
    if interrupts.received() or isinstance(error, KeyboardInterrupt | typer.Abort):
        return INTERRUPTED
    cause = error.__context__ if isinstance(error, SystemExit) else error  # typer and rich exit by themselves
    if isinstance(cause, BrokenPipeError):
        drop_output()
        return PIPE_CLOSED
    if isinstance(error, UsageError):
        words = error.format_message().replace("Value error, ", "")  # of the library that checks values
        message = f"{words}{commands.usage_hint(error)}"
    elif isinstance(error, CoopenvError):
        message = str(error)
    elif isinstance(error, OSError) or getattr(sys.stdout, "closed", False):
        file, why = getattr(error, "filename", None), getattr(error, "strerror", None)
        message = f"{file or 'standard output'}: {why or error}"
        drop_output()
    elif type(error).__name__.startswith("WarpCodegen"):  # an own observer's
        message = f"Warp cannot compile a kernel: {error}"
    elif isinstance(error, ModuleNotFoundError) and not str(error.name).startswith("coopenv"):
        message = f"needs the module {error.name}, as in the whole of coopenv: {install_command('svea')}"
    else:
        raise error
    if sys.stderr is not None:
        with suppress(OSError, ValueError):
            print(f"error: {' '.join(message.split())}", file=sys.stderr)
    return 2


def drop_output() -> None:
    """Drop output that could not be written, so that it is not written again at exit."""
    with suppress(OSError, ValueError, AttributeError), open(os.devnull, "wb") as nothing:  # noqa: PTH123
        os.dup2(nothing.fileno(), sys.stdout.fileno())


@app.callback(invoke_without_command=True)
def root(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False,
) -> None:
    """Cooperative localisation of connected vehicles."""
    if version:
        print(f"coopenv {installed_version()}")
    else:
        commands.print_help(context)
