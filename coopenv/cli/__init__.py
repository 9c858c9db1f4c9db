"""The command line, `coopenv COMMAND`; `coopenv --help` lists the commands.

Commands import what they need when they run, so that `--help` and completion are quick.
"""

import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from typing import Annotated, Any

import typer

from coopenv.base import interrupts
from coopenv.base.errors import CoopenvError
from coopenv.base.installation import version as installed_version
from coopenv.cli import show
from coopenv.cli.bench import bench
from coopenv.cli.run import export, figures, import_command, record_command, run
from coopenv.cli.show import page
from coopenv.cli.svea import svea
from coopenv.cli.train import dataset, evaluate, train
from coopenv.cli.view import film, play, view, watch

UsageError: Any = typer.BadParameter.__base__  # raised for every mistake in the options; it has no public name
INTERRUPTED, PIPE_CLOSED = 130, 141  # exit statuses, 128 plus the number of the signal

app = typer.Typer(
    name="coopenv",
    help="Cooperative localisation of connected vehicles.",
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.command("list")(show.list_command)
app.command()(show.describe)
app.command()(show.scene)
app.command()(show.schema)
app.command()(run)
app.command()(figures)
app.command()(export)
app.command("record")(record_command)
app.command("import")(import_command)
app.command()(dataset)
app.command()(train)
app.command()(evaluate)
app.command()(watch)
app.command()(play)
app.command()(view)
app.command()(film)
app.command()(page)
app.add_typer(bench, name="bench")
app.add_typer(svea, name="svea")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status.

    It is 0, 2 after a mistake in the input or a result that cannot be written, 130 after Ctrl-C, 141 if the output is
    closed, and 143 after SIGTERM.
    """
    try:
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
        message = error.format_message().replace("Value error, ", "")  # a word of the library that checks values
    elif isinstance(error, CoopenvError):
        message = str(error)
    elif isinstance(error, OSError):
        message = f"{error.filename or 'standard output'}: {error.strerror or error}"
        drop_output()
    else:
        raise error
    if sys.stderr is not None:
        with suppress(OSError):
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
    elif context.invoked_subcommand is None:
        print(context.get_help())
