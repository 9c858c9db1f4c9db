"""Commands that guests and installed packages add to `coopenv`, under the entry point group `coopenv.commands`.

An entry point is a function with Typer's annotations, or a `typer.Typer` with several commands. Its name is that of the
command. Its module is imported when the command is run or listed, so it should import little.
"""

from collections.abc import Callable, MutableMapping
from typing import Any

import typer
from typer.core import TyperCommand

from coopenv.base.errors import CoopenvError
from coopenv.base.plugins import loaded, offered, own
from coopenv.cli import options

GROUP = "coopenv.commands"


def in_panel(panel: str) -> Callable[[Any], Any]:
    """Return a decorator that sets the group of a command in the list of commands."""

    def mark(function: Any) -> Any:
        function.panel = panel
        return function

    return mark


class Extended(options.Grouped):
    """The commands of coopenv, and those of guests and packages, each loaded when it is looked for."""

    @property
    def commands(self) -> MutableMapping[str, Any]:
        """All commands by name; the help of one that cannot be loaded gives the reason."""
        for name in offered(GROUP):
            try:
                self._find(name)
            except CoopenvError as error:
                self._known[name] = TyperCommand(name, help=str(error), callback=None)
        return self._known

    @commands.setter
    def commands(self, known: MutableMapping[str, Any]) -> None:
        self._known = known

    def get_command(self, ctx: typer.Context, cmd_name: str) -> Any:  # type: ignore[override]
        """Return a command, None if there is none. Raises CoopenvError: it cannot be loaded."""
        return self._find(cmd_name)

    def _find(self, name: str) -> Any:
        if name not in self._known and (point := own(GROUP).get(name) or offered(GROUP).get(name)):
            self._known[name] = made(name, loaded(point, "command"))
        return self._known.get(name)


def made(name: str, given: Any) -> Any:
    """Return the command of an entry point's object. Raises CoopenvError: it is no function and no `typer.Typer`."""
    if isinstance(given, typer.Typer):
        command: Any = typer.main.get_group(given)
        command.name, command.rich_help_panel = name, given.rich_help_panel
        return command
    if not callable(given):
        raise CoopenvError(f"command '{name}': expected a function or a typer.Typer, got {type(given).__name__}")
    alone = typer.Typer(add_completion=False, rich_markup_mode=None)
    alone.command(name, rich_help_panel=getattr(given, "panel", None))(given)
    return typer.main.get_command(alone)
