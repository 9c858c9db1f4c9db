"""`coopenv svea`: cars, real ones and fakes. Commands import what they need when they run."""

import typer

from coopenv.cli.svea.gate import gate
from coopenv.cli.svea.keys import keys
from coopenv.cli.svea.run import run

svea = typer.Typer(name="svea", help="SVEA cars, real ones and fakes.", no_args_is_help=True, rich_markup_mode=None)
svea.command()(gate)
svea.command()(keys)
svea.command()(run)
