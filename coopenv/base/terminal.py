"""A console for texts as they are and tables that are never cut."""

import re
from io import StringIO
from typing import Any

from rich.console import Console, ConsoleOptions, RenderResult
from rich.table import Table
from rich.text import Text

from coopenv.base.errors import printable

NARROWEST = 20  # columns; a terminal that states fewer has 80
PLAIN: dict[str, Any] = {"markup": False, "highlight": False, "emoji": False}


class Terminal(Console):
    """Prints texts as they are, control characters escaped; lines of tables that do not fit are longer than it."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**{**PLAIN, **options})
        if self.width < NARROWEST:  # COLUMNS=0
            self.width = 80

    def print(self, *objects: Any, **options: Any) -> None:
        """Print, without cutting what is longer than a line."""
        super().print(*objects, **{"crop": False, **options})

    def render_str(self, text: str, **options: Any) -> Text:
        """Return a text without control characters, which names in foreign files may have."""
        return super().render_str(re.sub(r"[^\n\t]+", lambda part: printable(part[0]), text), **options)


class NumberTable(Table):
    """A table that takes the width that it needs: at least that of its longest words, where texts may be wrapped."""

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        width = self.__rich_measure__(console, options.update(max_width=10_000))
        needed = width.maximum if all(column.no_wrap for column in self.columns) else width.minimum
        return super().__rich_console__(console, options.update(max_width=max(options.max_width, needed)))


def text_of(shown: Any, width: int) -> str:
    """Return what a console of a width prints of an object."""
    text = StringIO()
    Terminal(file=text, width=width).print(shown)
    return text.getvalue()
