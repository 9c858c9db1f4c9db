"""The command line: `coopenv list | describe | schema | run | record | bench`.

Commands import what they need when they run, so that `--help` and completion are quick.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Annotated, Any

import typer

from coopenv.cli import show
from coopenv.cli.bench import bench
from coopenv.cli.options import INTERRUPTED
from coopenv.cli.run import record_command, run
from coopenv.errors import CoopenvError
from coopenv.shipped import version as installed_version

UsageError: Any = typer.BadParameter.__base__
"""What typer raises for every mistake in the options; it has no public name."""

app = typer.Typer(
    name="coopenv",
    help="Cooperative localisation of connected vehicles.",
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.command("list")(show.list_command)
app.command()(show.describe)
app.command()(show.schema)
app.command()(run)
app.command("record")(record_command)
app.add_typer(bench, name="bench")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status: 0, 2 after a mistake in the input, 130 after Ctrl-C."""
    try:
        status = app(args=arguments, standalone_mode=False)
    except (CoopenvError, UsageError) as error:
        message = error.format_message() if isinstance(error, UsageError) else str(error)
        print(f"error: {' '.join(message.split())}", file=sys.stderr)
        return 2
    except (KeyboardInterrupt, typer.Abort):
        print("interrupted", file=sys.stderr)
        return INTERRUPTED
    return status if isinstance(status, int) else 0


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
