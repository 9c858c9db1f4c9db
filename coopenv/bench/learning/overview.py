"""The page that lays the agents of a study side by side: `README.md` in their folder."""

from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

from coopenv.base.files import replace_text
from coopenv.bench.agents import cards, table
from coopenv.bench.agents.seeds_section import percent
from coopenv.bench.agents.table import cell
from coopenv.bench.learning.cards import COMPARED, relative
from coopenv.bench.learning.judge import Judge
from coopenv.bench.learning.study import Group
from coopenv.evaluation import Difference

PAGE_FILE = "README.md"
BASE_ARM = "plain"
"""The arm that others are compared with."""
COLUMNS = {metric: table.COLUMNS[metric] for metric in COMPARED}
"""Metric, its heading, and the factor to the heading's unit."""
INTRODUCTION = """# Agents

One folder per driver, each with a card; [docs/agents.md](../docs/agents.md) describes the scripted drivers.
`study.toml` lists the learned agents, `train.toml` their settings and arms. `make agents` trains them and writes this
page. It shows the best seed of each agent, chosen by the training reward in other worlds.
"""
LEGEND = """95 % intervals over {worlds} held-out worlds, the same for all agents. e50 and e95: percentiles of
the position error of vehicles under way, from 3 s on. The last column lists the seeds in their order."""


def write(groups: Sequence[Group], folder: Path, judge: Judge) -> None:
    """Write the page of agents, each of which has a card; those that are to be trained anew are left out of it."""
    parts = [INTRODUCTION]
    for environment in dict.fromkeys(group.environment for group in groups):
        found = {group: cards.read(folder / group.name) for group in groups if group.environment == environment}
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
        told = [f"{name} {percent(changes['e95_m'])}" for name, changes in card["study"]["against"].items()]
        lines.append(f"- `{group.name}`: e95 against {', '.join(told)}.")
    base = next((group for group in found if group.arm == BASE_ARM), None)
    for group in found:
        if base is not None and group != base:
            best, bases = (folder / g.name / f"seed_{found[g]['study']['best']}" for g in (group, base))
            differences = judge.against(environment, best, bases)
            change = f"{_told(differences)}; median seed against median seed: {_medians(found[group], found[base])}"
            lines.append(f"- `{group.name}` against `{base.name}`: {change}.")
    return "\n".join([*lines, ""])


def _row(name: str, figures: dict[str, Any], errors: str) -> str:
    cells = [cell(figures[metric], factor) for metric, (_, factor) in COLUMNS.items()]
    return f"| {name} | {' | '.join(cells)} | {errors} |"


def _medians(card: dict[str, Any], base: dict[str, Any]) -> str:
    """Return how the medians over seeds differ, which no lucky seed moves."""
    told = []
    for word, metric in (("e50", "e50_m"), ("e95", "e95_m")):
        own, other = (
            median(entry["results"][metric]["mean"] for entry in each["study"]["seeds"].values())
            for each in (card, base)
        )
        told.append(f"{word} {100 * (own / other - 1):+.0f} %")
    return ", ".join(told)


def _told(differences: Sequence[Difference]) -> str:
    words = {"e50_m": "e50", "e95_m": "e95", "travel_time_s": "travel time"}
    found = {d.metric: d for d in differences}
    return ", ".join(f"{word} {percent(relative(found[metric]))}" for metric, word in words.items())
