"""`python -m coopenv.backends.mrclam NAME --data DIR`: the filters' errors on a recorded sub-dataset."""

from __future__ import annotations

from pathlib import Path
from statistics import fmean
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from coopenv.backends.mrclam.dataset import Dataset, load_dataset
from coopenv.backends.mrclam.events import VARIANTS, Variant
from coopenv.backends.mrclam.judge import Score, replay
from coopenv.backends.mrclam.planar import PLAIN, TUNINGS, Tuning
from coopenv.errors import CoopenvError

WIDTH = 140  # a narrower terminal wraps the lines rather than loses the cells
Row = tuple[str, Variant | None, Tuning]


def rows() -> list[Row]:
    """Return what is measured: name, variant, tuning."""
    first: list[Row] = [("dead reckoning", None, PLAIN)]
    return first + [(name, variant, tuning) for variant in VARIANTS for name, tuning in TUNINGS.items()]


def table_of(dataset: Dataset) -> Table:
    """Measure a sub-dataset and return the table."""
    seen = sum(len(frame.subjects) for robot in dataset.robots for frame in robot.frames)
    skipped = sum(robot.skipped for robot in dataset.robots)
    title = f"{dataset.name}: {dataset.duration_s:.0f} s, {seen} detections, {skipped} with unknown barcode skipped"
    table = Table(title=title)
    for column in ("variant", "filter"):
        table.add_column(column)
    for column in ("position m", "of robots 1..5", "heading deg", "ANEES", "rejected", "B/s", "us"):
        table.add_column(column, justify="right")
    for name, variant, tuning in rows():
        scores = replay(dataset, variant, tuning)[1]
        table.add_row(variant or "-", name, *_cells(scores))
    return table


def _cells(scores: list[Score]) -> list[str]:
    used = sum(score.accepted + score.rejected for score in scores)
    rejected = sum(score.rejected for score in scores)
    return [
        f"{fmean(score.position_rmse_m for score in scores):.3f}",
        " ".join(f"{score.position_rmse_m:.3f}" for score in scores),
        f"{fmean(score.heading_rmse_deg for score in scores):.2f}",
        f"{fmean(score.anees for score in scores):.2f}",
        f"{100 * rejected / used:.1f} %" if used else "-",
        f"{fmean(score.sent_bytes_per_s for score in scores):.0f}",
        f"{fmean(score.us_per_update for score in scores):.1f}",
    ]


def main(
    name: Annotated[str, typer.Argument(metavar="NAME", help="mrclam_1 .. mrclam_9")],
    data: Annotated[Path | None, typer.Option(help="the sub-dataset's folder or its parent (or COOPENV_DATA)")] = None,
) -> None:
    """Replay a recorded sub-dataset through the planar filters and judge them with motion capture."""
    try:
        table = table_of(load_dataset(name, data))
    except CoopenvError as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(2) from None
    Console(width=max(Console().width, WIDTH)).print(table)


if __name__ == "__main__":
    typer.run(main)
