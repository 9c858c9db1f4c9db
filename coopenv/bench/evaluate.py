"""`coopenv evaluate`: from the options to tables and files."""

from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from coopenv.base.files import check_new, replace_text, replacing_folder
from coopenv.base.format import NONE, json_text
from coopenv.base.installation import version, versions
from coopenv.bench.cards import (
    COLUMNS,
    EXPLANATIONS,
    Contest,
    Evaluation,
    changes,
    figures,
    shown,
    signed,
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


def document(evaluation: Evaluation, command: str) -> dict[str, Any]:
    """Return the content of `evaluation.json`; `command` is the line that gives the same figures again."""
    return {
        "command": command,
        "coopenv": version(),
        "versions": versions("numpy", "warp-lang"),
        "environment": evaluation.environment,
        "overrides": dict(evaluation.overrides),
        "worlds": evaluation.worlds,
        "seed_block": evaluation.block,
        "metrics": {name: {"unit": metric.unit, "meaning": metric.meaning} for name, metric in METRICS.items()},
        "rows": evaluation.rows(),
        "reference": evaluation.reference,
        "differences": evaluation.difference_rows(),
        "seen_share": {
            name: {
                own: dict(zip(e.vehicles, row, strict=True))
                for own, row in zip(e.vehicles, e.seen_share.tolist(), strict=True)
            }
            for name, e in evaluation.episodes.items()
        },
    }


def run(
    contest: Contest,
    command: str,
    log: Console,
    *,
    out: Path | None = None,
    figures: str | None = None,
    width: str | None = None,
    film: bool = False,
    force: bool = False,
) -> Evaluation:
    """Evaluate, with progress shown, and write the files.

    Args:
        contest: what is evaluated.
        command: the command line that gives the same figures again.
        log: console of the progress.
        out: folder of the files, which is replaced as a whole; None: no files.
        figures: their format; None: no figures and no replay.
        width: column of `coopenv.viz.figures` that figures are drawn for; None: a page's.
        film: whether a film is written.
        force: whether an earlier evaluation in the folder is replaced.

    Raises:
        OutputError: the folder holds an earlier evaluation that is not to be replaced, or it cannot be written.
    """

    def driven() -> Evaluation:
        with Progress(log, "driving", total=len(contest.entrants)) as progress, compile_notice(log):
            return contest.drive(lambda done, name: progress.update(done, f"driving: {name}"))

    if out is None:
        return driven()
    check_new(out / JSON_FILE, force)
    names = [JSON_FILE, *(f"{name}.{form}" for name in FIGURES for form in FORMATS), *FILMS, REPLAY_FILE]
    with replacing_folder(out, [*names, *(path.name for path in out.glob("replay_*.html"))]) as new:
        evaluation = driven()
        replace_text(new / JSON_FILE, json_text(document(evaluation, command)))
        if figures is not None or film:
            from coopenv.bench import evaluate_figures

        if figures is not None:
            with Progress(log, "drawing figures"):
                evaluate_figures.save_figures(evaluation, new, figures, width)
            evaluate_figures.write_replays(evaluation, new, log)
        if film:
            evaluate_figures.write_film(evaluation, new, log)
    return evaluation


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
    for name, e in evaluation.episodes.items():
        pairs = [(e.vehicles[i], e.vehicles[j], e.seen_share[i, j]) for i, j in np.argwhere(e.seen_share >= 0.01)]
        if pairs:
            words = ", ".join(f"{own} measures {other} {share:.0%}" for own, other, share in pairs)
            out.print(f"{name}, share of the time under way: {words}.")


def _results_table(evaluation: Evaluation) -> Table:
    """Return one row per driver: figures, with their intervals below."""
    table = number_table(("agent",), [heading for heading, _ in COLUMNS.values()], gap=0)
    for name, results in evaluation.results.items():
        found = figures(results)
        table.add_row(name, *(_cell(*shown(found[metric], factor)) for metric, (_, factor) in COLUMNS.items()))
    return table


def _differences_table(evaluation: Evaluation) -> Table:
    """Return one row per driver but the reference: relative differences, with their intervals below."""
    headings = [COLUMNS[metric][0].split("\n")[0] for metric in COMPARED]
    headings[-1] += " (deg)"
    table = number_table((f"against {evaluation.reference}",), [f"{heading}\n[%]" for heading in headings], gap=0)
    for name, differences in evaluation.differences.items():
        found = changes(differences, COMPARED)
        table.add_row(name, *(_cell(*map(signed, shown(found[metric], 100.0, "relative"))) for metric in COMPARED))
    return table


def _cell(mean: str, low: str, high: str) -> str:
    return mean if low == NONE else f"{mean}\n{low}..{high}"
