"""`coopenv figures | export`: what an earlier run has written, drawn anew or in the formats of other programs."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from coopenv.cli import options

RunFolder = Annotated[Path, typer.Argument(metavar="RUN", help="Folder that `coopenv run` has written.")]
ExportFormat = StrEnum("ExportFormat", {"tum": "tum", "layout": "foxglove-layout"})
Exported = Annotated[
    Path, typer.Argument(metavar="RUN|FILE.mcap", help="Folder that `coopenv run` has written, or log of `record`.")
]
LAYOUT_FILE = "foxglove_layout.json"


def figures(
    run: RunFolder,
    file_format: Annotated[
        options.FigureFormat, typer.Option("--format", help="Format of the files.")
    ] = options.FigureFormat.pdf,
    width: options.FigureWidth = None,
    out: Annotated[Path | None, typer.Option(help="Folder of the figures (default: RUN/figures).")] = None,
) -> None:
    """Draw the figures of an earlier run again, for example for a paper."""
    from coopenv.runs.command import figure_words
    from coopenv.runs.console import Progress
    from coopenv.runs.results import Results

    results, folder = Results.read(run), out or run / "figures"
    with options.warned(), Progress(options.console(stderr=True), "drawing figures"):
        from coopenv.viz.figures import save_figures

        paths = save_figures(
            results.trajectory,
            folder,
            scenario=results.scenario(),
            ends=results.ends,
            steady_from=results.steady_from,
            file_format=file_format.value,
            **figure_words(results.metrics, width and width.value),
        )
    options.console().print(f"Files in {folder}: {', '.join(path.name for path in paths)}", soft_wrap=True)


def export(
    source: Exported,
    file_format: Annotated[
        ExportFormat,
        typer.Option(
            "--format",
            help="tum: true and estimated trajectories of a run, which evo reads. foxglove-layout: how Foxglove and "
            "Lichtblick arrange a log.",
        ),
    ] = ExportFormat.tum,
    out: Annotated[
        Path | None,
        typer.Option(help=f"Folder of the trajectories (default: RUN/tum), or file (default: {LAYOUT_FILE})."),
    ] = None,
) -> None:
    """Write a run or a log in the formats of other programs."""
    if file_format is ExportFormat.layout:
        _export_layout(source, out or Path(LAYOUT_FILE))
        return
    from coopenv.runs.results import Results
    from coopenv.runs.tum import write_tum

    folder = out or source / file_format.value
    paths = write_tum(Results.read(source).trajectory, folder)
    options.console().print(f"Files in {folder}: {', '.join(path.name for path in paths)}", soft_wrap=True)


def _export_layout(log: Path, out: Path) -> None:
    from coopenv.backends.mcap.format import topics_of
    from coopenv.base.errors import DataError
    from coopenv.base.files import replace_text
    from coopenv.viz.foxglove.views import layout_text

    topics = topics_of(log)
    if "/scene/world" not in topics:
        raise DataError(f"{log}: has no scene, `coopenv record --scene` writes one")
    replace_text(out, layout_text(topics))
    options.console().print(f"{out}: import it in Foxglove or Lichtblick (Layouts, Import from file)", soft_wrap=True)
