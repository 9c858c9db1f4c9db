"""A console for texts as they are and tables that are never cut."""

import re
from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from io import StringIO
from typing import Any

from rich.console import Console, ConsoleOptions, RenderResult
from rich.table import Column, Table
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


CONTINUED = ("\n", "from\n", "at\n")  # beginnings of headings that continue the heading of the column before


class NumberTable(Table):
    """A table that takes the width that it needs: at least that of its longest words, where texts may be wrapped."""

    def __init__(self, folds: bool, **options: Any) -> None:
        """Take rich's options; `folds`: columns that do not fit stand in a further table with the same first one."""
        super().__init__(**options)
        self.folds = folds

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        wide = options.update(max_width=10_000)
        width = self.__rich_measure__(console, wide)
        needed = width.maximum if all(column.no_wrap for column in self.columns) else width.minimum
        starts = [i for i in range(2, len(self.columns)) if not str(self.columns[i].header).startswith(CONTINUED)]
        if self.folds and needed > options.max_width and starts:
            parts = [self._of(self.columns[:start]) for start in starts]
            fitting = [part for part in parts if part.__rich_measure__(console, wide).maximum <= options.max_width]
            first = [*parts[:1], *fitting][-1]
            return [first, self._of([self.columns[0], *self.columns[len(first.columns) :]])]
        return super().__rich_console__(console, options.update(max_width=max(options.max_width, needed)))

    def _of(self, columns: Sequence[Column]) -> "NumberTable":
        part = copy(self)
        part.columns = [replace(column, _index=i) for i, column in enumerate(columns)]
        return part


def text_of(shown: Any, width: int) -> str:
    """Return what a console of a width prints of an object."""
    text = StringIO()
    Terminal(file=text, width=width).print(shown)
    return text.getvalue()
