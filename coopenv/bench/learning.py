"""`coopenv bench learning`: train what is missing, side by side, and write a card as each run ends."""

import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import median
from typing import Any

import tomlkit
from rich.console import Console
from rich.table import Table

from coopenv.base.files import replace_text
from coopenv.base.format import json_text
from coopenv.base.installation import version
from coopenv.bench import cards as agents_cards
from coopenv.bench.cards import cell, percent
from coopenv.bench.executors import Local
from coopenv.bench.study import REPORTED, Group, Judge, Run, Study, is_finished, perform, tasks
from coopenv.evaluation import Difference, Result
from coopenv.policies.loader import AGENT_FILE
from coopenv.runs.console import Progress, number_table
from coopenv.training.settings import SETTINGS_FILE

BASELINES = ("route_follower", "peek", "look_ahead")
COMPARED = ("arrival_rate", "collision_rate", "travel_time_s", "e50_m", "e95_m")


def finished_groups(study: Study, folder: Path) -> dict[Group, list[Run]]:
    """Return the runs that are finished, as study and environments are now, of each group that has any."""
    done = {group: [Run(group, seed) for seed in study.seeds] for group in study.groups}
    done = {group: [run for run in runs if is_finished(study, run, folder)] for group, runs in done.items()}
    return {group: runs for group, runs in done.items() if runs}


def is_reported(group: Group, runs: Sequence[Run], folder: Path) -> bool:
    """Return whether a group has a card that tells of just these finished runs."""
    seeds = agents_cards.read(folder / group.name).get("study", {}).get("seeds", {})
    found = {int(seed): entry["runs"]["sha256"] for seed, entry in seeds.items()}
    return found == {run.seed: _trained(folder / run.folder)["sha256"] for run in runs}


def write_cards(study: Study, group: Group, finished: Sequence[Run], folder: Path, judge: Judge) -> None:
    """Write the agent and the card of a group of which some runs are finished.

    Which seed is the best is decided by the return that it learnt from, in held-out worlds of their own.
    """
    runs = {run.seed: run for run in finished}
    overrides, place = study.settings[group].scenario, folder / group.name
    merits = {seed: judge.merit(group.environment, folder / run.folder, overrides) for seed, run in runs.items()}
    best = max(merits, key=lambda seed: merits[seed])
    results = {seed: judge.results(group.environment, folder / run.folder) for seed, run in runs.items()}
    description = _write_agent(place, runs[best].folder.name, group, sorted(runs))
    chosen = folder / runs[best].folder
    against = {name: judge.against(group.environment, chosen, name) for name in BASELINES}
    baselines = {name: judge.results(group.environment, name) for name in BASELINES}
    baselines["ideal_sensing"] = judge.ideal(group.environment, BASELINES[0])
    agents = ",".join(str(folder / run.folder) for run in runs.values())
    command = f"coopenv evaluate {group.environment} --agents {agents},{','.join(BASELINES)} --worlds {judge.worlds}"
    card = {
        "agent": group.name,
        "kind": "learned",
        "environments": {
            group.environment: {
                "command": f"{command} --seed-block {REPORTED} --ideal",
                "coopenv": version(),
                "worlds": judge.worlds,
                "seed_block": REPORTED,
                "results": _figures(results[best]),
            }
        },
        "study": {
            "arm": group.arm,
            "best": best,
            "seeds": {
                str(seed): {
                    "runs": _trained(folder / run.folder),
                    "merit": merits[seed],
                    "results": _figures(results[seed]),
                }
                for seed, run in runs.items()
            },
            "beside": {name: _figures(found) for name, found in baselines.items()},
            "against": {name: _changes(found) for name, found in against.items()},
        },
    }
    replace_text(place / agents_cards.JSON_FILE, json_text(card))
    replace_text(place / agents_cards.TEXT_FILE, agents_cards.text(description, card))


def _trained(place: Path) -> dict[str, Any]:
    """Return the training of an agent, from its folder."""
    document = tomllib.loads((place / AGENT_FILE).read_text(encoding="utf-8"))
    training = document["training"]
    found = {key: training[key] for key in ("steps", "cpu_minutes", "command")}
    return {"sha256": document["network"]["sha256"], **found}


def _write_agent(place: Path, best: str, group: Group, seeds: Sequence[int]) -> str:
    """Write the agent that drives as one seed of it does, with its settings, and return its description."""
    document = tomlkit.parse((place / best / AGENT_FILE).read_text(encoding="utf-8"))
    names = ", ".join(map(str, seeds))
    description = f"PPO in {group.environment}, arm {group.arm}: {best.replace('_', ' ')}, the best of {names}."
    document["title"], document["description"] = f"{group.environment}, {group.arm}", description
    document["network"]["weights"] = f"{best}/{document['network']['weights']}"
    replace_text(place / AGENT_FILE, tomlkit.dumps(document))
    replace_text(place / SETTINGS_FILE, (place / best / SETTINGS_FILE).read_text(encoding="utf-8"))
    return description


def _figures(results: Sequence[Result]) -> dict[str, dict[str, float]]:
    return {r.metric: {"mean": r.mean, "ci_low": r.ci_low, "ci_high": r.ci_high, "n": r.n} for r in results}


def _changes(differences: Sequence[Difference]) -> dict[str, dict[str, float]]:
    return {d.metric: relative(d) for d in differences if d.metric in COMPARED}


def relative(difference: Difference) -> dict[str, float]:
    """Return a difference as a share of the other one's figure."""
    ends = {"ci_low": difference.relative_ci_low, "ci_high": difference.relative_ci_high}
    return {"relative": difference.relative, **ends}


PAGE_FILE = "README.md"
BASE_ARM = "plain"
"""The arm that others are compared with."""
COLUMNS = {metric: agents_cards.COLUMNS[metric] for metric in COMPARED}
"""Metric, its heading, and the factor to the heading's unit."""
INTRODUCTION = """# Agents

One folder per driver, each with a card; [docs/agents.md](../docs/agents.md) describes the scripted drivers.
`study.toml` lists the learned agents, `train.toml` their settings and arms. `make agents` trains them and writes this
page. It shows the best seed of each agent, chosen by the training reward in other worlds.
"""
LEGEND = """95 % intervals over {worlds} held-out worlds, the same for all agents. e50 and e95: percentiles of
the position error of vehicles under way, from 3 s on. The last column lists the seeds in their order."""


def write_overview(groups: Sequence[Group], folder: Path, judge: Judge) -> None:
    """Write the page of agents, each of which has a card; those that are to be trained anew are left out of it."""
    parts = [INTRODUCTION]
    for environment in dict.fromkeys(group.environment for group in groups):
        found = {group: agents_cards.read(folder / group.name) for group in groups if group.environment == environment}
        parts.append(_section(environment, found, folder, judge))
    replace_text(folder / PAGE_FILE, "\n".join(parts))


def _section(environment: str, found: dict[Group, dict[str, Any]], folder: Path, judge: Judge) -> str:
    headings = " | ".join(heading.replace("\n", " ") for heading, _ in COLUMNS.values())
    lines = [f"## {environment}", "", f"| agent | {headings} | e95 of seeds [cm] |", "|---" * (len(COLUMNS) + 2) + "|"]
    newest = list(found.values())[-1]
    for name, figures in newest["study"]["beside"].items():
        lines.append(_row(name, figures, ""))
    for group, card in found.items():
        seeds = card["study"]["seeds"].values()
        errors = ", ".join(f"{100 * entry['results']['e95_m']['mean']:.1f}" for entry in seeds)
        results = card["environments"][environment]["results"]
        lines.append(_row(f"[`{group.name}`]({group.name}/card.md)", results, errors))
    lines += ["", LEGEND.format(worlds=newest["environments"][environment]["worlds"]), ""]
    for group, card in found.items():
        others = [f"{name} {percent(changes['e95_m'])}" for name, changes in card["study"]["against"].items()]
        lines.append(f"- `{group.name}`: e95 against {', '.join(others)}.")
    base = next((group for group in found if group.arm == BASE_ARM), None)
    for group in found:
        if base is not None and group != base:
            best, bases = (folder / g.name / f"seed_{found[g]['study']['best']}" for g in (group, base))
            differences = judge.against(environment, best, bases)
            change = (
                f"{_changes_of(differences)}; median seed against median seed: {_medians(found[group], found[base])}"
            )
            lines.append(f"- `{group.name}` against `{base.name}`: {change}.")
    return "\n".join([*lines, ""])


def _row(name: str, figures: dict[str, Any], errors: str) -> str:
    cells = [cell(figures[metric], factor) for metric, (_, factor) in COLUMNS.items()]
    return f"| {name} | {' | '.join(cells)} | {errors} |"


def _medians(card: dict[str, Any], base: dict[str, Any]) -> str:
    """Return how the medians over seeds differ, which no lucky seed moves."""
    found = []
    for word, metric in (("e50", "e50_m"), ("e95", "e95_m")):
        own, other = (
            median(entry["results"][metric]["mean"] for entry in each["study"]["seeds"].values())
            for each in (card, base)
        )
        found.append(f"{word} {100 * (own / other - 1):+.0f} %")
    return ", ".join(found)


def _changes_of(differences: Sequence[Difference]) -> str:
    words = {"e50_m": "e50", "e95_m": "e95", "travel_time_s": "travel time"}
    found = {d.metric: d for d in differences}
    return ", ".join(f"{word} {percent(relative(found[metric]))}" for metric, word in words.items())


WIDTH = 100
"""Width of the table without a terminal, characters."""


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
        finished = finished_groups(study, folder)
        stale = {group: runs for group, runs in finished.items() if not is_reported(group, runs, folder)}
        for group, runs in stale.items():
            write_cards(study, group, runs, folder, judge)
        if stale or not (folder / PAGE_FILE).exists():
            write_overview(list(finished), folder, judge)

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
        ("agent", "seeds"), [*(heading for heading, _ in COLUMNS.values()), "e95 of\nseeds [cm]"], gap=0
    )
    for group in study.groups:
        card = agents_cards.read(folder / group.name)
        if "study" not in card:
            continue
        seeds = card["study"]["seeds"]
        results = card["environments"][group.environment]["results"]
        errors = " ".join(f"{100 * entry['results']['e95_m']['mean']:.0f}" for entry in seeds.values())
        figures = [cell(results[metric], factor).replace(" ", "\n", 1) for metric, (_, factor) in COLUMNS.items()]
        table.add_row(group.name, str(len(seeds)), *figures, errors)
    return table
