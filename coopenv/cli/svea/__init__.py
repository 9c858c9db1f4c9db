"""`coopenv svea`: cars, real ones and fakes. Commands import what they need when they run."""

import typer

from coopenv.cli.svea.demo import demo
from coopenv.cli.svea.fake import fake
from coopenv.cli.svea.gate import gate
from coopenv.cli.svea.health import health
from coopenv.cli.svea.keys import keys
from coopenv.cli.svea.router import router
from coopenv.cli.svea.run import run

svea = typer.Typer(name="svea", help="SVEA cars, real ones and fakes.", no_args_is_help=True, rich_markup_mode=None)
svea.command()(demo)
svea.command()(fake)
svea.command()(gate)
svea.command()(health)
svea.command()(keys)
svea.command()(router)
svea.command()(run)
