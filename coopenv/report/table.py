"""A tidy table: columns with name, title, unit and format, and a value of each in every row.

`print` of a console shows it, and a notebook shows it as HTML; `csv`, `markdown` and `latex` return it as text, and
`Tabular` gives it to other programs.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from io import StringIO
from typing import TYPE_CHECKING, Any, Self

import numpy as np

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions, RenderResult

UNITS = {
    "gramian_min_eigenvalue": "mixed",
    "bytes_per_s": "byte/s",
    "us_per_update": "us",
    "_m_per_s": "m/s",
    "_rad_per_s": "rad/s",
    "_per_s": "1/s",
    "_m": "m",
    "_s": "s",
    "_deg": "deg",
    "_rad": "rad",
}
"""End of a column's name to its unit, the first that fits; of other numbers it is 1."""


def texts(values: Iterable[Any]) -> list[str]:
    """Return values as texts: lists with commas between, floats as short as they are exact to six digits."""
    return [
        ", ".join(value) if isinstance(value, list) else f"{value:g}" if isinstance(value, float) else str(value)
        for value in values
    ]


@dataclass(frozen=True)
class Column:
    """A column of a table."""

    name: str
    """Key of its value in a record, and its name for other programs."""
    title: str | None = None
    """Heading for people, of one or several lines; None: the name."""
    unit: str = ""
    """Shown below the title; empty: none is shown."""
    write: Callable[[Any], Sequence[str]] = texts
    """Returns the cells of all values."""
    number: bool = True
    """Numbers stand to the right."""
    wraps: bool = False
    """Cells that do not fit into a line of a terminal are broken."""
    width: int | None = None
    """Characters on a terminal; None: as many as there are."""
    least: int | None = None
    """Least number of characters on a terminal, where cells wrap."""

    @property
    def heading(self) -> str:
        """Title, and unit on a line of its own."""
        title = self.name if self.title is None else self.title
        return f"{title}\n[{self.unit}]" if self.unit else title


@dataclass(eq=False)
class Table:
    """A table, column by column."""

    columns: Sequence[Column]
    values: Mapping[str, Sequence[Any] | np.ndarray]
    """Values by name of the column, of equal length."""
    keys: tuple[str, ...] = ()
    """Columns whose values together name a row."""
    mixed: tuple[str, ...] = ()
    """Columns of numbers whose units differ from row to row."""
    title: str | None = None
    """Heading of a table of texts, in which long cells are broken; None: of numbers."""
    gap: int = 1
    """Further spaces between columns on a terminal."""
    folds: bool = False
    """On a terminal, columns that do not fit into a line stand in a further table with the same first column."""
    strong: list[int] = field(default_factory=list)
    """Rows in bold letters."""
    rules: list[int] = field(default_factory=list)
    """Rows above which LaTeX draws a line."""

    @classmethod
    def of(cls, columns: Sequence[Column], records: Iterable[Any], **look: Any) -> Self:
        """Return the table of records, which are mappings or objects; `look` are further fields."""
        rows = list(records)
        return cls(columns, {column.name: [_value(row, column.name) for row in rows] for column in columns}, **look)

    @classmethod
    def of_data(
        cls, values: Mapping[str, Sequence[Any] | np.ndarray], keys: Sequence[str], mixed: Sequence[str] = ()
    ) -> Self:
        """Return the table of columns by name, whose units follow from their names."""
        return cls([*map(Column, values)], values, tuple(keys), tuple(mixed))

    @classmethod
    def of_rows(cls, rows: Sequence[Any], *keys: str) -> Self:
        """Return dataclasses of one kind, at least one, with a column per field."""
        return cls.of_data({each.name: [getattr(row, each.name) for row in rows] for each in fields(rows[0])}, keys)

    @classmethod
    def of_texts(
        cls, names: Sequence[str], numbers: Sequence[str] = (), rows: Iterable[Sequence[str]] = (), **look: Any
    ) -> Self:
        """Return a table of cells that are texts already, by the titles of columns of names, then of numbers."""
        titles = [*((title, False) for title in names), *((title, True) for title in numbers)]
        columns = [Column(str(i), title, number=number) for i, (title, number) in enumerate(titles)]
        table = cls(columns, {column.name: [] for column in columns}, **look)
        for row in rows:
            table.add(*row)
        return table

    def add(self, *cells: Any) -> None:
        """Add a row to a table of texts; in LaTeX the last of fewer cells takes the place of the missing ones."""
        for column, cell in zip(self.columns, (*cells, *[""] * (len(self.columns) - len(cells))), strict=True):
            values = self.values[column.name]
            assert isinstance(values, list)
            values.append(cell)

    def __len__(self) -> int:
        return len(self.values[self.columns[0].name])

    @property
    def headings(self) -> list[str]:
        """Headings of the columns, of one or several lines each."""
        return [column.heading for column in self.columns]

    @property
    def cells(self) -> list[Sequence[str]]:
        """Cells as texts, column by column."""
        return [column.write(self.values[column.name]) for column in self.columns]

    @property
    def units(self) -> dict[str, str]:
        """The unit of every column of numbers that has one."""
        known = {name: values for name, values in self.values.items() if name not in self.mixed}
        numbers = [name for name, values in known.items() if np.asarray(values).dtype.kind in "fiu"]
        return {name: next((u for end, u in UNITS.items() if name.endswith(end)), "1") for name in numbers}

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        from rich import box
        from rich.table import Table as RichTable

        from coopenv.report.terminal import NumberTable

        look: dict[str, Any] = {"padding": (0, self.gap, 0, 0), "show_edge": False}
        if self.title is None:
            drawn: RichTable = NumberTable(self.folds, box=box.HORIZONTALS, pad_edge=False, **look)
        else:
            look |= {"title_justify": "left", "title_style": "italic"}
            drawn = RichTable(title=self.title, box=box.SIMPLE_HEAD, **look)
        wrapped = any(column.wraps for column in self.columns)
        for column, cells in zip(self.columns, self.cells, strict=True):
            whole = max(map(len, cells), default=0) if wrapped and not column.wraps else None
            drawn.add_column(
                column.heading,
                justify="right" if column.number else "left",
                no_wrap=not column.wraps,
                overflow="ellipsis" if self.title is None else "fold",
                width=column.width,
                min_width=column.least or whole,
            )
        for i, row in enumerate(zip(*self.cells, strict=True)):
            drawn.add_row(*row, style="bold" if i in self.strong else None)
        yield drawn

    def _repr_html_(self) -> str:
        from coopenv.report.notebook import terminal_html

        return terminal_html(self)

    def csv(self) -> str:
        """Return the values as CSV; numbers that are not finite are empty."""
        text = StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(self.values)
        columns = (values.tolist() if isinstance(values, np.ndarray) else values for values in self.values.values())
        writer.writerows([_finite(value) for value in row] for row in zip(*columns, strict=True))
        return text.getvalue()

    def markdown(self) -> str:
        """Return the cells in Markdown; lines within a cell come one after the other, with semicolons between."""
        heads = [heading.strip().replace("\n", " ") for heading in self.headings]
        rows = (map(_in_markdown, row) for row in (heads, *zip(*self.cells, strict=True)))
        heading, *lines = (f"| {' | '.join(row)} |" for row in rows)
        return "\n".join([heading, "|---" * len(self.columns) + "|", *lines])

    def latex(self, *comments: str) -> str:
        """Return the cells as a LaTeX table (package booktabs) below comments.

        The last of fewer cells than columns spans the missing ones.
        """
        from coopenv.report.templates import rendered

        def line(row: Sequence[str]) -> str:
            shown = [*map(_latex, row)]
            missing = len(row) - max(i for i, text in enumerate(row, start=1) if text)
            if missing:
                shown[-missing - 1 :] = [rf"\multicolumn{{{missing + 1}}}{{l}}{{{shown[-missing - 1]}}}"]
            return " & ".join(shown)

        return rendered(
            "table.tex.j2",
            comments=comments,
            columns="".join("r" if column.number else "l" for column in self.columns),
            heading=line(self.headings),
            rows=[line(row) for row in zip(*self.cells, strict=True)],
            rules=self.rules,
        )


def markdown(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table of texts in Markdown."""
    return Table.of_texts(columns, rows=rows).markdown()


def bullets(lines: Iterable[str]) -> str:
    """Return a list in Markdown."""
    return "\n".join(f"- {plain(line)}" for line in lines)


def plain(text: str) -> str:
    """Return a text on one line, without what Markdown would read as a tag."""
    return " ".join(text.split()).replace("<", "&lt;")


def _in_markdown(text: str) -> str:
    return plain("; ".join(text.splitlines())).replace("|", "\\|")


def _latex(text: str) -> str:
    """Return a cell in LaTeX, its lines stacked; special characters stand for themselves."""
    stacked = re.sub(r"([&%$#_{}])", r"\\\1", text.replace("\\", "/")).replace("\n", r"\\")
    return rf"\shortstack[l]{{{stacked}}}" if r"\\" in stacked else stacked


def _value(row: Any, name: str) -> Any:
    return row[name] if isinstance(row, Mapping) else getattr(row, name)


def _finite(value: Any) -> Any:
    return "" if isinstance(value, float) and not math.isfinite(value) else value
