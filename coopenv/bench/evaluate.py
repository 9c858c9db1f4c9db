"""`coopenv evaluate`: from the options to tables and files."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console

from coopenv.base.errors import OutputError
from coopenv.base.files import replace_text, replacing_folder
from coopenv.base.format import json_text
from coopenv.base.installation import version, versions
from coopenv.bench.cards import EXPLANATIONS, differences_table, results_table
from coopenv.bench.contest import Entrant, Evaluation, contest, enter
from coopenv.evaluation import METRICS
from coopenv.runs.command import REPLAY_FILE
from coopenv.runs.console import Progress, compile_notice
from coopenv.viz import FORMATS

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
    """Folder of the files; None: no files."""
    figures: str | None = None
    """Format of the figures; None: no figures and no replay."""
    film: bool = False
    force: bool = False
    """Whether an earlier evaluation in the folder is replaced."""
    width: str | None = None
    """Column of `coopenv.viz.figures` that figures are drawn for; None: a page's."""

    @property
    def name(self) -> str:
        """Name of the environment."""
        return Path(self.environment).stem

    def entrants(self) -> list[Entrant]:
        """Return the drivers, built."""
        return enter(self.environment, self.name, self.overrides, self.agents, self.ideal)


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
    """Evaluate, with progress shown."""
    with Progress(log, "driving", total=len(entrants)) as progress, compile_notice(log):
        return contest(
            request.name,
            entrants,
            request.worlds,
            request.block,
            lambda done, name: progress.update(done, f"driving: {name}"),
        )


def write(folder: Path, request: Request, entrants: Sequence[Entrant], log: Console) -> Evaluation:
    """Evaluate and write everything to a folder, which is replaced as a whole.

    Raises:
        OutputError: it holds an earlier evaluation that is not to be replaced, or it cannot be written.
    """
    if (folder / JSON_FILE).exists() and not request.force:
        raise OutputError(f"{folder / JSON_FILE}: exists already; --force replaces it")
    earlier = [path.name for path in folder.glob("replay_*.html")]
    with replacing_folder(folder, [*result_names(), *earlier]) as new:
        evaluation = run(request, entrants, log)
        replace_text(new / JSON_FILE, json_text(document(request, evaluation)))
        if request.figures is not None:
            from coopenv.bench.evaluate_figures import save_figures, write_replays

            with Progress(log, "drawing figures"):
                save_figures(evaluation, new, request.figures, request.width)
            write_replays(evaluation, new, log)
        if request.film:
            from coopenv.bench.evaluate_figures import write_film

            write_film(evaluation, new, log)
    return evaluation


def result_names() -> list[str]:
    """Return the names of all files that an evaluation can write, but for the pages of further drivers."""
    return [JSON_FILE, *(f"{name}.{form}" for name in FIGURES for form in FORMATS), *FILMS, REPLAY_FILE]


def report(evaluation: Evaluation, out: Console) -> None:
    """Print the tables."""
    seeds = f"{evaluation.worlds} held-out worlds, block {evaluation.block} of the seeds"
    out.print(f"{evaluation.environment}: {seeds}, the same for all.", soft_wrap=True)
    out.print()
    out.print(results_table(evaluation))
    if evaluation.differences:
        out.print()
        out.print(differences_table(evaluation))
    out.print()
    for words, meaning in EXPLANATIONS.items():
        out.print(f"{words}: {meaning}.")
