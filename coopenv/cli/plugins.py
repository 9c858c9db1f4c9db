"""Commands that guests and installed packages add to `coopenv`, under the entry point group `coopenv.commands`.

An entry point is a function with Typer's annotations, or a `typer.Typer` with several commands. Its name is that of the
command. Its module is imported when the command is run or listed, so it should import little.
"""

from collections.abc import MutableMapping
from importlib.metadata import EntryPoint
from typing import Any

import typer
from typer.core import TyperCommand

from coopenv.base.errors import CoopenvError
from coopenv.base.plugins import loaded, offered, own
from coopenv.cli import commands

GROUP = "coopenv.commands"


class Extended(commands.Grouped):
    """The commands of coopenv, and those of guests and packages, each loaded when it is looked for."""

    @property
    def commands(self) -> MutableMapping[str, Any]:
        """All commands by name; the help of one that cannot be loaded gives the reason."""
        return {name: self.get_command(None, name) for name in self.list_commands(None)}

    @commands.setter
    def commands(self, known: MutableMapping[str, Any]) -> None:
        self._known = known

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the names of all commands, of which none is loaded."""
        return list(dict.fromkeys([*self._known, *offered(GROUP)]))

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Return a command, None if there is none. Raises CoopenvError: it is to be run and cannot be loaded."""
        if cmd_name not in self._known and (point := own(GROUP).get(cmd_name) or offered(GROUP).get(cmd_name)):
            try:
                self._known[cmd_name] = _made(point)
            except CoopenvError as error:
                if ctx is not None and not ctx.resilient_parsing:
                    raise
                return TyperCommand(cmd_name, help=str(error), callback=None)
        return self._known.get(cmd_name)


def _made(point: EntryPoint) -> Any:
    """Return the command of an entry point, listed under the name of its package."""
    given: Any = loaded(point, "command")
    if isinstance(given, typer.Typer):
        command: Any = typer.main.get_group(given)
    elif callable(given):
        alone = typer.Typer(add_completion=False, rich_markup_mode=None)
        alone.command(point.name)(given)
        command = typer.main.get_command(alone)
    else:
        raise CoopenvError(f"command '{point.name}': expected a function or a typer.Typer, got {given!r:.60}")
    command.name = point.name
    command.rich_help_panel = point.value.removeprefix("coopenv.").partition(".")[0].partition(":")[0].capitalize()
    return command
