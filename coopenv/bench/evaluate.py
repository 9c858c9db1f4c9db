"""`coopenv evaluate`: from the options to tables and files; `coopenv.evaluate`."""

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from rich.console import Console

from coopenv.base.errors import explained
from coopenv.base.files import check_new, replace_text, replacing_folder
from coopenv.base.format import json_text
from coopenv.base.installation import names_of, version, versions
from coopenv.base.terminal import Terminal
from coopenv.bench.cards import Contest, Evaluation
from coopenv.evaluation import METRICS
from coopenv.runs.command import REPLAY_FILE
from coopenv.runs.console import Progress, compile_notice
from coopenv.scenario import ScenarioLike
from coopenv.viz import FORMATS

JSON_FILE = "evaluation.json"
FIGURES = ("error_along_the_way", "time_against_error", "looking")
FILMS = ("video.mp4", "video.gif")


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
        "rows": evaluation.rows,
        "reference": evaluation.reference,
        "differences": evaluation.difference_rows,
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

            scenes = evaluate_figures.scenes_of(evaluation, log)
        if figures is not None:
            with Progress(log, "drawing figures"):
                evaluate_figures.save_figures(evaluation, new, figures, width)
            evaluate_figures.write_replays(evaluation, scenes, new, log)
        if film:
            evaluate_figures.write_film(scenes, new, log)
    return evaluation


@explained
def evaluate(
    environment: ScenarioLike,
    agents: str | Callable[..., Any] | Iterable[str | Callable[..., Any]] = (),
    worlds: int = 256,
    *,
    overrides: Mapping[str, Any] | None = None,
    seed_block: int = 0,
    ideal: bool = False,
) -> Evaluation:
    """Let agents drive in the same held-out worlds, as `coopenv evaluate` does; printed, the result is its tables.

    For example `coopenv.evaluate("facade", ["route_follower", "peek"], worlds=64).to_pandas()`.

    Args:
        environment: name, TOML file, dict or scenario, as for `coopenv.load_scenario`.
        agents: one or several names, folders, import paths (`mine.py:Mine`), classes or functions; none: every shipped
            agent made for the environment.
        worlds: how many.
        overrides: dotted scenario keys.
        seed_block: number of the block of held-out seeds.
        ideal: let `route_follower` drive under ideal sensing, too.

    Raises:
        CoopenvError: an argument is not valid, or an agent cannot drive here.
    """
    contest = Contest.of(environment, overrides or {}, names_of(agents), worlds, seed_block, ideal)
    return run(contest, "", Terminal(stderr=True))
