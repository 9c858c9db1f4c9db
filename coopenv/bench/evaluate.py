"""`coopenv evaluate`: from the options to tables and files."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from coopenv.base.errors import OutputError
from coopenv.base.files import replace_text, replacing_folder
from coopenv.base.format import NONE, json_text
from coopenv.base.installation import version, versions
from coopenv.bench.cards import (
    COLUMNS,
    EXPLANATIONS,
    Entrant,
    Evaluation,
    changes,
    contest,
    enter,
    figures,
    shown,
    signed,
    values_of,
)
from coopenv.evaluation import METRICS
from coopenv.runs.command import REPLAY_FILE
from coopenv.runs.console import Progress, compile_notice, number_table
from coopenv.viz import FORMATS

COMPARED = ("travel_time_s", "e50_m", "e95_m", "orientation_e95_deg")
JSON_FILE = "evaluation.json"
FIGURES = ("error_along_the_way", "time_against_error", "looking")
FILMS = ("video.mp4", "video.gif")
WIDTH = 100
"""Width of the tables without a terminal, characters."""


class Request(NamedTuple):
    """An evaluation, and where its results go."""

    environment: str
    agents: Sequence[str]
    worlds: int
    block: int
    overrides: Mapping[str, Any]
    ideal: bool
    command: str
    """The command line that gives the same figures again."""
    out: Path | None = None
    """Folder of the files, which is replaced as a whole; None: no files."""
    figures: str | None = None
    """Format of the figures; None: no figures and no replay."""
    film: bool = False
    force: bool = False
    """Whether an earlier evaluation in the folder is replaced."""
    width: str | None = None
    """Column of `coopenv.viz.figures` that figures are drawn for; None: a page's."""

    def entrants(self) -> list[Entrant]:
        """Return the drivers, built."""
        return enter(self.environment, self.overrides, self.agents, self.ideal)


def document(request: Request, evaluation: Evaluation) -> dict[str, Any]:
    """Return the content of `evaluation.json`."""
    return {
        "command": request.command,
        "coopenv": version(),
        "versions": versions("numpy", "warp-lang"),
        "environment": evaluation.environment,
        "overrides": dict(request.overrides),
        "worlds": evaluation.worlds,
        "seed_block": evaluation.block,
        "metrics": {name: {"unit": metric.unit, "meaning": metric.meaning} for name, metric in METRICS.items()},
        "rows": evaluation.rows(),
        "reference": evaluation.reference,
        "differences": evaluation.difference_rows(),
    }


def run(request: Request, entrants: Sequence[Entrant], log: Console) -> Evaluation:
    """Evaluate, with progress shown, and write the files.

    Raises:
        OutputError: the folder holds an earlier evaluation that is not to be replaced, or it cannot be written.
    """
    folder = request.out
    if folder is None:
        return _driven(request, entrants, log)
    if (folder / JSON_FILE).exists() and not request.force:
        raise OutputError(f"{folder / JSON_FILE}: exists already; --force replaces it")
    names = [JSON_FILE, *(f"{name}.{form}" for name in FIGURES for form in FORMATS), *FILMS, REPLAY_FILE]
    with replacing_folder(folder, [*names, *(path.name for path in folder.glob("replay_*.html"))]) as new:
        evaluation = _driven(request, entrants, log)
        replace_text(new / JSON_FILE, json_text(document(request, evaluation)))
        if request.figures is not None or request.film:
            from coopenv.bench import evaluate_figures

        if request.figures is not None:
            with Progress(log, "drawing figures"):
                evaluate_figures.save_figures(evaluation, new, request.figures, request.width)
            evaluate_figures.write_replays(evaluation, new, log)
        if request.film:
            evaluate_figures.write_film(evaluation, new, log)
    return evaluation


def _driven(request: Request, entrants: Sequence[Entrant], log: Console) -> Evaluation:
    with Progress(log, "driving", total=len(entrants)) as progress, compile_notice(log):
        return contest(
            request.environment,
            entrants,
            request.worlds,
            request.block,
            lambda done, name: progress.update(done, f"driving: {name}"),
        )


def report(evaluation: Evaluation, out: Console) -> None:
    """Print the tables of an evaluation."""
    seeds = f"{evaluation.worlds} held-out worlds, block {evaluation.block} of the seeds"
    out.print(f"{evaluation.environment}: {seeds}, the same for all.", soft_wrap=True)
    out.print()
    out.print(_results_table(evaluation))
    if evaluation.differences:
        out.print()
        out.print(_differences_table(evaluation))
    out.print()
    for words, meaning in EXPLANATIONS.items():
        out.print(f"{words}: {meaning}.")


def _results_table(evaluation: Evaluation) -> Table:
    """Return one row per driver: figures, with their intervals below."""
    table = number_table(("agent",), [heading for heading, _ in COLUMNS.values()], gap=0)
    for name, results in evaluation.results.items():
        found = figures(results)
        texts = [shown(*values_of(found[metric], factor)) for metric, (_, factor) in COLUMNS.items()]
        table.add_row(name, *(mean if low == NONE else f"{mean}\n{low}..{high}" for mean, low, high in texts))
    return table


def _differences_table(evaluation: Evaluation) -> Table:
    """Return one row per driver but the reference: relative differences, with their intervals below."""
    headings = [COLUMNS[metric][0].split("\n")[0] for metric in COMPARED]
    headings[-1] += " (deg)"
    table = number_table((f"against {evaluation.reference}",), [f"{heading}\n[%]" for heading in headings], gap=0)
    for name, differences in evaluation.differences.items():
        found = changes(differences, COMPARED)
        texts = [[signed(text) for text in shown(*values_of(found[metric], 100.0, "relative"))] for metric in COMPARED]
        known = [np.isfinite(found[metric]["ci_low"]) for metric in COMPARED]
        pairs = zip(texts, known, strict=True)
        table.add_row(name, *(f"{mean}\n{low}..{high}" if both else mean for (mean, low, high), both in pairs))
    return table
