"""`coopenv bench learning`: train what is missing, side by side, and write a card as each run ends."""

from collections.abc import Callable
from pathlib import Path

from rich.console import Console
from rich.table import Table

from coopenv.bench.agents import cards as agents_cards
from coopenv.bench.agents.table import cell
from coopenv.bench.executors import Local
from coopenv.bench.learning import cards, overview
from coopenv.bench.learning.judge import Judge
from coopenv.bench.learning.study import Study
from coopenv.bench.learning.work import perform, tasks
from coopenv.runs.console import Progress
from coopenv.runs.table import number_table

WIDTH = 100
"""Characters that the table is wide where no terminal says otherwise."""


def run(study: Study, part: Study, folder: Path, logs: Path, jobs: int, worlds: int, log: Console) -> None:
    """Train every run of a part of a study that is not finished, and bring all cards up to date.

    Whatever ends it, going on is the same command: finished runs stay, others go on from their checkpoints.

    Args:
        study: what cards tell of.
        part: what is to be trained now.
        folder: for the agents.
        logs: for TensorBoard's files.
        jobs: trainings side by side, of one core each.
        worlds: held-out ones per agent.
        log: where progress is shown.

    Raises:
        CoopenvError: a training cannot be done.
        OutputError: something cannot be written.
    """
    judge, missing = Judge(worlds), tasks(part, folder, logs)
    total = len(list(part.runs))
    folder.mkdir(parents=True, exist_ok=True)

    def judge_finished() -> None:
        finished = cards.finished_groups(study, folder)
        stale = {group: runs for group, runs in finished.items() if not cards.is_told(group, runs, folder)}
        for group, runs in stale.items():
            cards.write(study, group, runs, folder, judge)
        if stale or not (folder / overview.PAGE_FILE).exists():
            overview.write(list(finished), folder, judge)

    with Progress(
        log, f"{total - len(missing)} of {total} trainings were done", total=len(missing) or None
    ) as progress:
        judge_finished()
        on_done = _reporter(judge_finished, progress, total - len(missing), total)
        if missing:
            Local(jobs).map(perform, missing, on_done)


def _reporter(judge_finished: Callable[[], None], progress: Progress, before: int, total: int) -> Callable[[int], None]:
    def on_done(done: int) -> None:
        progress.update(done, f"{before + done} of {total} trainings are done")
        judge_finished()

    return on_done


def results_table(study: Study, folder: Path) -> Table:
    """Return one row per agent: the figures of its best seed, and how its seeds differ."""
    table = number_table(
        ("agent", "seeds"), [*(heading for heading, _ in overview.COLUMNS.values()), "e95 of\nseeds [cm]"], gap=0
    )
    for group in study.groups:
        card = agents_cards.read(folder / group.name)
        if "study" not in card:
            continue
        seeds = card["study"]["seeds"]
        results = card["environments"][group.environment]["results"]
        errors = " ".join(f"{100 * entry['results']['e95_m']['mean']:.0f}" for entry in seeds.values())
        figures = [
            cell(results[metric], factor).replace(" ", "\n", 1) for metric, (_, factor) in overview.COLUMNS.items()
        ]
        table.add_row(group.name, str(len(seeds)), *figures, errors)
    return table
