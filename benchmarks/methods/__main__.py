"""`python -m benchmarks.methods`: the runs of a study that lack a result, one after the other, and the table of all.

`make study` is the same with the study of this folder. Every run writes its row of the results as it ends. An
interrupted run begins anew when the command is repeated, so that its result does not depend on the interruption; a
finished one is kept until its settings, environment or recordings change. Needs the extra `study`.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

from benchmarks.methods import report, study
from coopenv.api.engine import Engine
from coopenv.base.errors import CoopenvError, check_one_of
from coopenv.base.files import replace_text
from coopenv.base.installation import install_command, names_of, needing
from coopenv.evaluation import drive, held_out_seeds, score
from coopenv.policies import Policy, load_agent
from coopenv.sources.sources import open_simulation

HERE = Path(__file__).resolve().parent


def perform(asked: study.StudyFile, run: study.Run, data: Path) -> study.Figures:
    """Train, unless a scripted driver is meant, and judge; return the figures."""
    scenario, method = open_simulation(run.environment, {}), asked.methods.get(run.method)
    with closing(Engine(scenario, asked.worlds, threads=1)) as engine:
        begin = time.process_time()
        if method is None:
            policy: Policy = load_agent(run.method, scenario)
        elif method.learner == "offline":
            from benchmarks.methods import offline

            agent = asked.environments[run.environment]
            rows = offline.transitions(offline.recorded(run.environment, agent, asked.decisions, asked.noise, data))
            begin = time.process_time()
            policy = offline.learn(rows, run.seed, method.options)
        else:
            from benchmarks.methods import online

            learn = {"benchmarl": online.benchmarl, "coopenv": online.coopenv_train}[method.learner]
            policy = learn(run.environment, asked.decisions, run.seed, method.options)(engine)
        spent = time.process_time() - begin
        found = score(drive(engine, policy, held_out_seeds(asked.block + run.seed, asked.worlds)))
    means = {result.metric: result.mean for result in found}
    return {"cpu_seconds": spent, **{name: means[name] for name in study.FIGURES}}


def parsed(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Return the command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.methods", description=__doc__)
    parser.add_argument("study", nargs="?", type=Path, default=HERE / "study.toml", help="default: study.toml here")
    parser.add_argument("--results", type=Path, help="default: results.csv beside the study")
    parser.add_argument("--data", type=Path, default=Path("out/methods"), help="of recordings (default: out/methods)")
    parser.add_argument("--only", default="", metavar="WORDS", help="environments, methods or seeds, with commas")
    parser.add_argument("--table", action="store_true", help="the table of the finished runs alone")
    parser.add_argument("--page", type=Path, help="write the page")
    return parser.parse_args(arguments)


def chosen(runs: Sequence[study.Run], words: Sequence[str]) -> list[study.Run]:
    """Return the runs that words choose, of which those of one column are alternatives.

    Raises:
        CoopenvError: no run has such a word.
    """
    columns = [{run.key[i] for run in runs} for i in range(3)]
    for word in words:
        check_one_of("--only: the study has no", word, sorted(set().union(*columns)))
    wanted = [{*words} & column or column for column in columns]
    return [run for run in runs if all(key in names for key, names in zip(run.key, wanted, strict=False))]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run what is missing and print the table; return the exit status: 0, or 2 after a mistake in the input."""
    asked = parsed(arguments)
    file = asked.results or asked.study.parent / "results.csv"
    try:
        read = study.read_study(asked.study)
        runs = study.runs(read)
        results = study.read_results(file, runs)
        missing = [run for run in chosen(runs, names_of(asked.only)) if run not in results and not asked.table]
        for number, run in enumerate(missing, start=1):
            with needing(f"the study of methods needs the extra study: {install_command('study')}"):
                found = perform(read, run, asked.data)
            results = {**study.read_results(file, runs), run: found}
            study.write_results(file, results)
            shown = ", ".join(f"{name} {found[name]:.3g}" for name in ("arrival_rate", "e95_m", "cpu_seconds"))
            print(f"{number}/{len(missing)} {' '.join(run.key[:3])}: {shown}", file=sys.stderr, flush=True)
        print(report.tables(read, results))
        if asked.page is not None:
            replace_text(asked.page, report.page(read, results))
    except CoopenvError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
