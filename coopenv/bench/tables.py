"""What the tables of measurements share."""

from __future__ import annotations

from collections.abc import Sequence

from rich import box
from rich.table import Table


def number_table(names: Sequence[str], numbers: Sequence[str], gap: int = 1) -> Table:
    """Return an empty table that fits a terminal: columns of names, then of numbers, `gap` spaces between them."""
    table = Table(box=box.HORIZONTALS, padding=(0, gap, 0, 0), pad_edge=False, show_edge=False)
    for heading in names:
        table.add_column(heading, no_wrap=True)
    for heading in numbers:
        table.add_column(heading, justify="right", no_wrap=True)
    return table
