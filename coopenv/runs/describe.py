"""Scenarios printed for people, in 80 columns."""

from collections.abc import Iterator
from typing import Any

from pydantic import BaseModel
from rich import box
from rich.console import RenderableType
from rich.table import Table
from rich.text import Text

from coopenv.runs import scenario_rows
from coopenv.runs.scenario_rows import Listing, settings
from coopenv.scenario.schema import Scenario

SECTIONS = ("camera", "rates", "noise", "topology", "v2x", "observer", "observation", "reward", "termination")
DRIVEN_SECTIONS = ("dynamics", "action")
"""Sections that matter only where actions drive a vehicle."""

DRAWN_SECTIONS = ("randomisation", "difficulty")
"""Sections that are shown only where they say something."""

VALUE_WIDTH = 17
WHOLE_COLUMNS = {"vehicle", "who", "time", "field", "slice", "shape", "unit", "scale"}
"""Columns that are not broken into lines."""


def describe_scenario(scenario: Scenario) -> Iterator[RenderableType]:
    """Yield everything about a scenario, part by part."""
    yield Text(f"{scenario.title}\n", "bold")
    for text in (scenario.description, scenario.source and f"Source: {scenario.source.strip()}"):
        if text:
            yield f"{' '.join(text.split())}\n"
    steps = round(scenario.horizon * scenario.rates.decision)
    yield f"Horizon: {scenario.horizon:g} s, {steps} decisions of {scenario.ticks_per_decision} camera ticks each.\n"
    for listing in scenario_rows.scene(scenario):
        yield listing_table(listing)
        yield ""
    yield Text("Settings (* differs from the default)\n", "bold")
    names = shown_sections(scenario)
    width = max(len(key) for name in names for key, *_ in settings(getattr(scenario, name))) + 2
    for name in names:
        yield section_table(name, getattr(scenario, name), width)
        yield ""
    yield listing_table(scenario_rows.observation(scenario))


def shown_sections(scenario: Scenario) -> list[str]:
    """Return the names of the sections that matter in a scenario."""
    names = [*SECTIONS, *(DRIVEN_SECTIONS if scenario.driven else ())]
    return names + [name for name in DRAWN_SECTIONS if getattr(scenario, name) != type(getattr(scenario, name))()]


def listing_table(listing: Listing) -> Table:
    """Return a listing as a table."""
    table = _table(*listing.columns, title=listing.title)
    for name, column in zip(listing.columns, table.columns, strict=True):
        column.no_wrap = name in WHOLE_COLUMNS
    for row in listing.rows:
        table.add_row(*row)
    return table


def section_table(name: str, part: BaseModel, key_width: int) -> Table:
    """Return one row per setting of a section: key, value, meaning with its unit."""
    doc = " ".join((type(part).__doc__ or "").split())
    table = _table(f"[{name}]", "value", "meaning", title=doc)
    table.columns[0].width, table.columns[1].width = key_width, VALUE_WIDTH
    for key, value, meaning, differs in settings(part):
        table.add_row(f"{key} *" if differs else key, value, meaning, style="bold" if differs else None)
    return table


def _table(*columns: str, title: str | None = None) -> Table:
    look: dict[str, Any] = {"title_justify": "left", "title_style": "italic"}
    return Table(*columns, title=title, box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), show_edge=False, **look)
