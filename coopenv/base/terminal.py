"""A console for texts as they are and tables that are never cut."""

from io import StringIO
from typing import Any

from rich.console import Console, ConsoleOptions, RenderResult
from rich.table import Table

PLAIN: dict[str, Any] = {"markup": False, "highlight": False, "emoji": False}


class Terminal(Console):
    """Prints scenario texts as they are; lines of tables that do not fit are longer than the console."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**{**PLAIN, **options})
        if self.width < 1:  # COLUMNS=0
            self.width = 80

    def print(self, *objects: Any, **options: Any) -> None:
        """Print, without cutting what is longer than a line."""
        super().print(*objects, **{"crop": False, **options})


class NumberTable(Table):
    """A table that takes the width that it needs."""

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        needed = self.__rich_measure__(console, options.update(max_width=10_000)).maximum
        return super().__rich_console__(console, options.update(max_width=max(options.max_width, needed)))


def text_of(printable: Any, width: int) -> str:
    """Return what a console of a width prints of an object."""
    text = StringIO()
    Terminal(file=text, width=width).print(printable)
    return text.getvalue()
