"""`coopenv import`: what is in ROS bags, and recordings made of them."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from coopenv.base.errors import CoopenvError, OutputError
from coopenv.cli import options

if TYPE_CHECKING:
    from rich.table import Table

    from coopenv.cars.bags.log import TopicRow


WIDTH = 100
"""Columns of a table that is not for a terminal."""


def import_command(
    bags: Annotated[list[Path], typer.Argument(metavar="BAG...", help="Bags of one drive, such as one per car.")],
    topics: options.TopicMap = None,
    out: Annotated[Path | None, typer.Option(help="MCAP file to write, a recording of coopenv.")] = None,
    seed: options.Seed = 0,
    overrides: options.Overrides = None,
    observer: options.LogObserver = None,
    scene: options.LogScene = True,
    force: Annotated[bool, typer.Option("--force", help="Replace a file that is there.")] = False,
    as_json: options.AsJson = False,
) -> None:
    """Say what ROS bags hold, and make a recording of them.

    Files and folders of ROS 1 and ROS 2. Without --map only their topics are listed.
    """
    if topics is None:
        if out is not None or overrides:
            raise CoopenvError(f"{'--out' if out else '--set'}: needs the map of the bags' topics, --map topics.toml")
        _print(_topics(bags), as_json)
        return
    from coopenv.backends.sources import open_bags

    if out is not None:
        from coopenv.runs.log import check_scene

        _check(out, force)
        if scene:
            check_scene(observer)
    with options.warned():
        bag = open_bags(bags, topics, options.parse_overrides(overrides))
    _print(bag.log.rows, as_json)
    ticks = bag.capabilities.ticks or 0
    seconds = (ticks - 1) / bag.scenario.rates.camera
    vehicles = len(bag.binding.cars)
    facts = f"{vehicles} vehicle{'s' * (vehicles > 1)}, {ticks} ticks, {seconds:.4g} s"
    if out is not None:
        from coopenv.runs.console import Progress
        from coopenv.runs.log import write_log
        from coopenv.runs.recorder import record

        log = options.console(stderr=True)
        with Progress(log, "recording", total=1.0) as progress:
            recording = record(bag, seed, on_progress=progress.update)
        write_log(recording, out, log, observer, scene)
    if not as_json:
        options.console().print(f"{out or bag.where}: {facts}", soft_wrap=True)


def _check(out: Path, force: bool) -> None:
    from coopenv.backends.mcap import check_target

    check_target(out)
    if out.exists() and not force:
        raise OutputError(f"{out}: exists already; --force replaces it")


def _topics(bags: Sequence[Path]) -> tuple[TopicRow, ...]:
    """Return what bags hold, without knowing what it is."""
    from coopenv.cars.bags.files import BagFile
    from coopenv.cars.bags.log import rows_of

    with ExitStack() as stack:
        return rows_of([stack.enter_context(BagFile(path)) for path in bags])


def _print(rows: Sequence[TopicRow], as_json: bool) -> None:
    if as_json:
        options.print_json([*rows])
        return
    printed = options.console()
    if not printed.is_terminal:
        printed.width = max(printed.width, WIDTH)
    printed.print(_table(rows))


def _table(rows: Sequence[TopicRow]) -> Table:
    from coopenv.runs.table import number_table

    read = any(row.role for row in rows)
    names = ["topic", *(["read as"] if read else []), *([] if read else ["type"])]
    numbers = ["messages", "rate\n[Hz]", *(["used", "longest\ngap [s]", "gaps", "clock\n[ms]"] if read else [])]
    table = number_table(names, numbers)
    for column in table.columns[: len(names)]:
        column.no_wrap, column.overflow = False, "fold"
    for row in rows:
        cells = [row.topic, f"{row.car} {row.role}" if row.role else "" if read else row.type]
        cells += [str(row.messages), _shown(row.rate, 1)]
        if read:
            offset = None if row.offset is None else 1e3 * row.offset
            cells += [_shown(row.used, 0), _shown(row.gap, 3), _shown(row.gaps, 0), _shown(offset, 1)]
        table.add_row(*cells)
    return table


def _shown(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
