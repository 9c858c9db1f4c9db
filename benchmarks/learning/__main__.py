"""`python -m benchmarks.learning STUDY.toml`: train agents by environment, arm and seed, and write their cards.

`make agents` is the same with `agents/study.toml`. Whatever ends it, going on is the same command. Needs the extra
`train`.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from rich.console import Console

from benchmarks.learning.study import Study, agent_of, is_finished, perform, read_study, unfinished
from benchmarks.options import at_least, status_of
from coopenv.base.errors import CoopenvError
from coopenv.base.installation import available_cores, install_command, names_of, needing
from coopenv.bench.executors import Local
from coopenv.report.terminal import Terminal
from coopenv.runs.console import Progress
from coopenv.sources.sources import open_simulation


def run(study: Study, part: Study, folder: Path, logs: Path, jobs: int, worlds: int, log: Console) -> None:
    """Train every run of a part of a study that is not finished, and bring all cards up to date.

    Whatever ends it, going on is the same command: finished runs stay, others go on from their checkpoints.

    Args:
        study: the trainings that cards compare.
        part: the trainings to run now.
        folder: for the agents.
        logs: for TensorBoard's files.
        jobs: trainings side by side, of one core each.
        worlds: held-out ones per agent.
        log: console of the progress.

    Raises:
        CoopenvError: a training cannot be done.
        OutputError: something cannot be written.
    """
    from benchmarks.learning.cards import PAGE_FILE, is_reported, write_card, write_overview
    from benchmarks.learning.judge import Judge

    judge, missing = Judge(worlds), unfinished(part, folder)
    total = len(part.plans)
    before = total - len(missing)
    folder.mkdir(parents=True, exist_ok=True)

    def judge_finished() -> None:
        of_agents = ([plan for plan in plans if is_finished(plan, folder)] for plans in study.agents.values())
        finished = [plans for plans in of_agents if plans]
        stale = [plans for plans in finished if not is_reported(agent_of(plans[0]), plans, folder)]
        for plans in stale:
            write_card(plans, folder, judge)
        if stale or not (folder / PAGE_FILE).exists():
            write_overview([plans[0] for plans in finished], folder, judge)

    with Progress(log, f"{before} of {total} trainings were done", total=len(missing) or None) as progress:

        def on_done(done: int) -> None:
            progress.update(done, f"{before + done} of {total} trainings are done")
            judge_finished()

        judge_finished()
        if missing:
            Local(jobs).map(partial(perform, folder, logs), missing, on_done)


def learn(asked: argparse.Namespace) -> None:
    """Train what is missing, and print the table."""
    if not asked.study.exists():
        raise CoopenvError(f"no such file of a study: {asked.study}")
    with needing(f"the study of learning needs the extra train: {install_command('train')}"):
        from benchmarks.learning.cards import results_table
    whole, log = read_study(asked.study), Terminal(stderr=True)
    chosen, folder = whole.only(names_of(asked.only)), asked.out or asked.study.parent
    for plans in chosen.agents.values():
        open_simulation(plans[0].environment, plans[0].settings.scenario)
    run(whole, chosen, folder, asked.logs, asked.jobs or available_cores(), asked.worlds, log)
    printed = Terminal()
    printed.print(results_table(chosen, folder))
    printed.print("Figures of the best seed, with 95 % intervals over worlds. More in every agent's card.md.")


def main(arguments: Sequence[str] | None = None) -> int:
    """Read the command line and learn; return the exit status: 0, or 2 after a mistake in the input."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.learning", description=__doc__)
    parser.add_argument("study", type=Path, help="TOML file of the study, such as agents/study.toml")
    parser.add_argument("--out", type=Path, help="folder for the agents (default: beside the study)")
    parser.add_argument("--only", default="", help="environments, arms and seeds with commas, such as facade,quality,1")
    parser.add_argument("--jobs", type=at_least(1), help="trainings side by side (default: one per core)")
    parser.add_argument("--worlds", type=at_least(2), default=256, help="held-out worlds for the cards (default: 256)")
    parser.add_argument("--logs", type=Path, default=Path("out", "tensorboard"), help="folder for TensorBoard's files")
    return status_of(learn, parser.parse_args(arguments))


if __name__ == "__main__":
    sys.exit(main())
