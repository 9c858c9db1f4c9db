"""Cards of trained agents, the page that lists them, and their table."""

import tomllib
from collections.abc import Iterable, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from statistics import median
from typing import Any

import tomlkit

from benchmarks.learning.judge import REPORTED, Judge
from benchmarks.learning.study import Study, agent_of, place_of
from coopenv.base.files import replace_text
from coopenv.bench import cards
from coopenv.bench.contest import IDEAL, IDEAL_SENSING
from coopenv.bench.evaluation import COLUMNS, cell, changes, figures, percent
from coopenv.policies.loader import AGENT_FILE
from coopenv.report.table import Table
from coopenv.report.templates import rendered
from coopenv.training.settings import SETTINGS_FILE, TrainingPlan

BASELINES = ("route_follower", "peek", "look_ahead")
PAGE_FILE = "README.md"
BASE_ARM = "plain"
"""The arm that others are compared with."""
CHANGES = {"e95_m": "e95", "e50_m": "e50", "travel_time_s": "travel time"}
"""Metrics whose changes stand on the page, and their names there."""


def is_reported(agent: str, plans: Sequence[TrainingPlan], folder: Path) -> bool:
    """Return whether an agent has a card of exactly these finished runs."""
    seeds = cards.read(folder / agent).get("study", {}).get("seeds", {})
    found = {int(seed): entry["runs"]["sha256"] for seed, entry in seeds.items()}
    return found == {plan.seed: _trained(folder / place_of(plan))["sha256"] for plan in plans}


def _trained(place: Path) -> dict[str, Any]:
    """Return the training of an agent, from its folder."""
    document = tomllib.loads((place / AGENT_FILE).read_text(encoding="utf-8"))
    training = document["training"]
    found = {key: training[key] for key in ("steps", "cpu_minutes", "command")}
    return {"sha256": document["network"]["sha256"], **found}


def write_card(finished: Sequence[TrainingPlan], folder: Path, judge: Judge) -> None:
    """Write an agent of which some runs are finished, and its card.

    Which seed is the best is decided by the return that it learnt from, in held-out worlds of their own.
    """
    environment, place = finished[0].environment, folder / agent_of(finished[0])
    agents = {plan.seed: folder / place_of(plan) for plan in finished}
    overrides = finished[0].settings.scenario
    merits = {seed: judge.merit(environment, agent, overrides) for seed, agent in agents.items()}
    best = max(merits, key=lambda seed: merits[seed])
    results = {seed: figures(judge.results(environment, agent)) for seed, agent in agents.items()}
    description = _write_agent(place, agents[best].name, finished)
    against = {name: judge.against(environment, agents[best], name) for name in BASELINES}
    beside = {name: judge.results(environment, name) for name in BASELINES}
    beside[IDEAL] = judge.results(environment, BASELINES[0], IDEAL_SENSING)
    driven = ",".join(map(str, (*agents.values(), *BASELINES)))
    command = (
        f"coopenv evaluate {environment} --agents {driven} --worlds {judge.worlds} --seed-block {REPORTED} --ideal"
    )
    study = {
        "arm": finished[0].arm,
        "best": best,
        "seeds": {
            str(seed): {"runs": _trained(agent), "merit": merits[seed], "results": results[seed]}
            for seed, agent in agents.items()
        },
        "beside": {name: figures(found) for name, found in beside.items()},
        "against": {name: changes(found, cards.OVERVIEW) for name, found in against.items()},
    }
    entry = cards.measured(command, judge.worlds, REPORTED, results[best])
    card = {"agent": place.name, "kind": "learned", "environments": {environment: entry}, "study": study}
    cards.save(place, description, card)


def _write_agent(place: Path, best: str, finished: Sequence[TrainingPlan]) -> str:
    """Write the agent that drives as one seed of it does, with its settings, and return its description."""
    document = tomlkit.parse((place / best / AGENT_FILE).read_text(encoding="utf-8"))
    environment, arm = finished[0].environment, finished[0].arm
    names = ", ".join(str(seed) for seed in sorted(plan.seed for plan in finished))
    description = f"PPO in {environment}, arm {arm}: {best.replace('_', ' ')}, the best of {names}."
    document["title"], document["description"] = f"{environment}, {arm}", description
    document["network"]["weights"] = f"{best}/{document['network']['weights']}"
    replace_text(place / AGENT_FILE, tomlkit.dumps(document))
    replace_text(place / SETTINGS_FILE, (place / best / SETTINGS_FILE).read_text(encoding="utf-8"))
    return description


def write_overview(agents: Iterable[TrainingPlan], folder: Path, judge: Judge) -> None:
    """Write the page of agents that have a card, of each a training; others are to be trained anew."""
    sections = {}
    for environment, plans in groupby(agents, lambda plan: plan.environment):
        own = {agent_of(plan): plan.arm for plan in plans}
        found = {name: cards.read(folder / name) for name in own}
        best = {name: folder / name / f"seed_{card['study']['best']}" for name, card in found.items()}
        base = next((name for name, arm in own.items() if arm == BASE_ARM), None)
        others = [name for name in own if base is not None and name != base]
        against = {name: judge.against(environment, best[name], best[str(base)]) for name in others}
        relative = {name: changes(found, cards.OVERVIEW) for name, found in against.items()}
        sections[environment] = {"cards": found, "base": base, "against": relative, "table": _table(environment, found)}
    known = {"percent": percent, "changes": changes_text, "medians": medians}
    replace_text(folder / PAGE_FILE, rendered("agents.md.j2", "benchmarks.learning", "", sections=sections, **known))


def _table(environment: str, found: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the figures of the agents of an environment, and of drivers beside them, in Markdown."""
    *_, newest = found.values()
    rows: list[tuple[Any, ...]] = [((name,), results, "") for name, results in newest["study"]["beside"].items()]
    for name, card in found.items():
        errors = ", ".join(f"{100 * error:.1f}" for error in seeds_of(card, "e95_m"))
        rows.append(((f"[`{name}`]({name}/card.md)",), card["environments"][environment]["results"], errors))
    return cards.figures_table(("agent",), rows, cards.OVERVIEW, ("e95 of seeds [cm]",))


def seeds_of(card: Mapping[str, Any], metric: str) -> list[float]:
    """Return a figure of every seed of a study."""
    return [entry["results"][metric]["mean"] for entry in card["study"]["seeds"].values()]


def changes_text(found: Mapping[str, Any], metrics: Iterable[str]) -> str:
    """Return relative differences of a card, with their intervals, by the names of the metrics."""
    return ", ".join(f"{CHANGES[metric]} {percent(found[metric])}" for metric in metrics)


def medians(card: Mapping[str, Any], base: Mapping[str, Any]) -> str:
    """Return the difference between the errors of the median seeds of two studies, in words."""
    shares = {m: median(seeds_of(card, m)) / median(seeds_of(base, m)) - 1 for m in ("e50_m", "e95_m")}
    return ", ".join(f"{CHANGES[metric]} {100 * share:+.0f} %" for metric, share in shares.items())


def results_table(study: Study, folder: Path) -> Table:
    """Return one row per agent: the figures of its best seed, and how its seeds differ."""
    columns = {metric: COLUMNS[metric] for metric in cards.OVERVIEW}
    headings = [*(heading for heading, _ in columns.values()), "e95 of\nseeds [cm]"]
    table = Table.of_texts(("agent", "seeds"), headings, gap=0)
    for agent, plans in study.agents.items():
        card = cards.read(folder / agent)
        if "study" not in card:
            continue
        results, errors = card["environments"][plans[0].environment]["results"], seeds_of(card, "e95_m")
        shown = [cell(results[m], factor).replace(" ", "\n", 1) for m, (_, factor) in columns.items()]
        table.add(agent, str(len(errors)), *shown, " ".join(f"{100 * error:.0f}" for error in errors))
    return table
