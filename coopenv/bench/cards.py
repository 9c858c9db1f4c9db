"""Drivers on the same held-out worlds, and their figures on cards: JSON for programs, Markdown for people."""

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from coopenv.api.engine import Engine
from coopenv.backends.sources import open_simulation
from coopenv.base.errors import CoopenvError
from coopenv.base.files import check_file, replace_text
from coopenv.base.format import NONE, json_text
from coopenv.base.installation import version
from coopenv.evaluation import Difference, Episodes, Result, compare_paired, drive, held_out_seeds, score
from coopenv.policies import Agent, Policy, agents_for, find_agent
from coopenv.policies.loader import CARD_FILES
from coopenv.runs import page
from coopenv.scenario import Scenario

BASELINE, IDEAL = "route_follower", "ideal_sensing"
"""Reference of all comparisons, and the name of the same driver under ideal sensing."""
IDEAL_SENSING: Mapping[str, Any] = {"sensing": "ideal"}


@dataclass(frozen=True)
class Entrant:
    """A driver, and the world it drives in."""

    agent: Agent
    name: str
    kind: str
    scenario: Scenario
    policy: Policy


@dataclass(frozen=True)
class Evaluation:
    """Results of drivers, by their names."""

    environment: str
    block: int
    entrants: tuple[Entrant, ...]
    episodes: Mapping[str, Episodes]
    results: Mapping[str, Sequence[Result]]
    reference: str
    """Driver that the differences are to."""
    differences: Mapping[str, Sequence[Difference]]

    @property
    def worlds(self) -> int:
        """Number of worlds of every driver."""
        return next(iter(self.episodes.values())).worlds

    def rows(self) -> list[dict[str, Any]]:
        """Return one flat row per driver and metric."""
        return [
            {"agent": entrant.name, "kind": entrant.kind, "environment": self.environment, **asdict(result)}
            for entrant in self.entrants
            for result in self.results[entrant.name]
        ]

    def difference_rows(self) -> list[dict[str, Any]]:
        """Return one flat row per driver that was compared with the reference, and metric."""
        return [
            {"agent": name, "reference": self.reference, "environment": self.environment, **asdict(difference)}
            for name, differences in self.differences.items()
            for difference in differences
        ]


def enter(environment: str, overrides: Mapping[str, Any], agents: Sequence[str], ideal: bool = False) -> list[Entrant]:
    """Return the drivers of an evaluation, built.

    Args:
        environment: name or TOML file.
        overrides: dotted keys of the scenario.
        agents: what `find_agent` takes; none: every shipped driver that was made for the environment.
        ideal: let the baseline drive under ideal sensing, too.

    Raises:
        CoopenvError: an agent does not exist or cannot drive here, two have one name, or nothing is driven here.
    """
    scenario, name = open_simulation(environment, overrides), Path(environment).stem
    if not scenario.driven:
        raise CoopenvError(f"{environment}: all motion here is prescribed, there is nothing to drive")
    found = [find_agent(text) for text in agents or agents_for(name)]
    if not found:
        raise CoopenvError(f"no agent of agents/ was made for {name}; name some with --agents A,B")
    entrants = [Entrant(agent, agent.name, agent.kind, scenario, agent.policy(scenario)) for agent in found]
    names = [entrant.name for entrant in entrants]
    for twice in (word for word in names if names.count(word) > 1 or (ideal and word == IDEAL)):
        raise CoopenvError(f"--agents: two are called '{twice}'")
    if ideal:
        agent, seeing = find_agent(BASELINE), open_simulation(environment, {**overrides, **IDEAL_SENSING})
        entrants.append(Entrant(agent, IDEAL, "reference", seeing, agent.policy(seeing)))
    return entrants


def contest(
    environment: str,
    entrants: Sequence[Entrant],
    worlds: int,
    block: int,
    on_progress: Callable[[float, str], None] = lambda done, name: None,
) -> Evaluation:
    """Let every entrant drive an episode in each of the same worlds, and judge them.

    Args:
        environment: its name or TOML file.
        entrants: those of one environment.
        worlds: how many.
        block: number of the block of held-out seeds.
        on_progress: called with the number of drivers that are done, shares included, and the driver's name.
    """
    seeds, episodes, engines = held_out_seeds(block, worlds), dict[str, Episodes](), dict[int, Engine]()
    with ExitStack() as stack:
        for place, entrant in enumerate(entrants):
            world = id(entrant.scenario)
            if world not in engines:
                engines[world] = stack.enter_context(closing(Engine(entrant.scenario, worlds)))
                engines[world].load()

            def report(share: float, place: int = place, name: str = entrant.name) -> None:
                on_progress(place + share, name)

            episodes[entrant.name] = drive(engines[world], entrant.policy, seeds, report)
    results = {name: score(own, block) for name, own in episodes.items()}
    reference = BASELINE if BASELINE in episodes else entrants[0].name
    others = {
        name: compare_paired(own, episodes[reference], block) for name, own in episodes.items() if name != reference
    }
    return Evaluation(Path(environment).stem, block, tuple(entrants), episodes, results, reference, others)


COLUMNS = {
    "arrival_rate": ("arrived\n[%]", 100.0),
    "collision_rate": ("collided\n[%]", 100.0),
    "travel_time_s": ("travel\n[s]", 1.0),
    "e50_m": ("e50\n[cm]", 100.0),
    "e95_m": ("e95\n[cm]", 100.0),
    "orientation_e95_deg": ("e95\n[deg]", 1.0),
    "few_targets_share": ("few\n[%]", 100.0),
    "return": ("return\n", 1.0),
}
"""Metric, its heading, and the factor to the heading's unit."""
EXPLANATIONS = {
    "intervals": "95 %, bootstrap over worlds",
    "e50, e95": "median and 95th percentile of the error of vehicles under way, from 3 s on",
    "few": "share of that time with fewer than three targets in view",
    "return": "sum of the rewards of a vehicle",
}
"""What the words of the tables mean."""


def figures(results: Sequence[Result]) -> dict[str, dict[str, float]]:
    """Return results as cards hold them, by metric."""
    return {r.metric: {"mean": r.mean, "ci_low": r.ci_low, "ci_high": r.ci_high, "n": r.n} for r in results}


def changes(differences: Sequence[Difference], metrics: Iterable[str]) -> dict[str, dict[str, float]]:
    """Return differences as shares of the other agent's figures, as cards hold them, by metric."""
    return {
        d.metric: {"relative": d.relative, "ci_low": d.relative_ci_low, "ci_high": d.relative_ci_high}
        for d in differences
        if d.metric in metrics
    }


def shown(mean: float, low: float, high: float) -> tuple[str, str, str]:
    """Return a figure and the ends of its interval with as many decimals as the first digit of its width needs."""
    width = high - low
    decimals = 1
    if np.isfinite(width) and width > 0.0:
        decimals = int(np.clip(-np.floor(np.log10(width)), 0, 2))
    first, second, third = (f"{v:z.{decimals}f}" if np.isfinite(v) else NONE for v in (mean, low, high))
    return first, second, third


def values_of(found: Mapping[str, Any], factor: float, figure: str = "mean") -> list[float]:
    """Return figure and interval as a card holds them, where null stands for no number."""
    return [float("nan") if found[key] is None else factor * found[key] for key in (figure, "ci_low", "ci_high")]


def cell(result: Mapping[str, Any], factor: float) -> str:
    """Return a figure of a card with its interval in brackets."""
    mean, low, high = shown(*values_of(result, factor))
    return NONE if mean == NONE else f"{mean} [{low}, {high}]"


def _percent(change: Mapping[str, Any]) -> str:
    """Return a relative difference of a card and its interval, in percent."""
    mean, low, high = shown(*values_of(change, 100.0, "relative"))
    return f"{signed(mean)} [{low}, {high}] %"


def signed(text: str) -> str:
    """Return a number with its sign."""
    return text if text.startswith("-") else f"+{text}"


CHANGES = {"e95_m": "e95", "e50_m": "e50", "travel_time_s": "travel time"}


def _changes_text(found: Mapping[str, Any], metrics: Iterable[str] = CHANGES) -> str:
    return ", ".join(f"{CHANGES[metric]} {_percent(found[metric])}" for metric in metrics)


JSON_FILE, TEXT_FILE = CARD_FILES


def check(entrants: Sequence[Entrant]) -> None:
    """Find out before any work whether every agent has a folder for its card, with a readable card or none.

    Raises:
        CoopenvError: one has not.
    """
    for entrant in entrants:
        if entrant.name == IDEAL:
            continue
        if entrant.agent.folder is None:
            raise CoopenvError(f"--write-card: {entrant.name} is a place in code; a card needs an agent's folder")
        read(entrant.agent.folder)
        for name in (JSON_FILE, TEXT_FILE):
            check_file(entrant.agent.folder / name)


def read(folder: Path) -> dict[str, Any]:
    """Return what `card.json` holds, results by environment under `environments`; nothing of them without a card.

    Raises:
        CoopenvError: `card.json` is not one.
    """
    path = folder / JSON_FILE
    if not path.exists():
        return {"environments": {}}
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        return {**document, "environments": dict(document["environments"])}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CoopenvError(f"{path}: not a card: {error}") from None


def write(evaluation: Evaluation, command: str) -> list[Path]:
    """Write the results of an evaluation to the cards of its agents; those of other environments stay."""
    written = []
    for entrant in evaluation.entrants:
        folder = entrant.agent.folder
        if folder is None or entrant.name == IDEAL:
            continue
        card = read(folder)
        known = card["environments"]
        results = figures(evaluation.results[entrant.name])
        known[evaluation.environment] = measured(command, evaluation.worlds, evaluation.block, results)
        card |= {"agent": entrant.name, "kind": entrant.kind, "environments": dict(sorted(known.items()))}
        written.append(save(folder, entrant.agent.description, card))
    return written


def measured(command: str, worlds: int, block: int, results: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entry of an environment in a card."""
    return {"command": command, "coopenv": version(), "worlds": worlds, "seed_block": block, "results": results}


def save(folder: Path, description: str, card: Mapping[str, Any]) -> Path:
    """Write a card to an agent's folder, and return the path of the one for people."""
    replace_text(folder / JSON_FILE, json_text(card))
    replace_text(folder / TEXT_FILE, text(description, card))
    return folder / TEXT_FILE


def figure_table(
    first: Sequence[str],
    rows: Iterable[tuple[Sequence[str], Mapping[str, Any], Sequence[str]]],
    last: Sequence[str] = (),
    metrics: Iterable[str] = COLUMNS,
) -> str:
    """Return a table in Markdown; each row has what stands before its figures, these by metric, and what stands after.

    Args:
        first: headings of what stands before.
        rows: of the table.
        last: headings of what stands after.
        metrics: of the columns between.
    """
    columns = [COLUMNS[metric] for metric in metrics]
    headings = [heading.strip().replace("\n", " ") for heading, _ in columns]
    factors = {metric: factor for metric, (_, factor) in zip(metrics, columns, strict=True)}
    lines = [
        (*before, *(cell(found[metric], factor) for metric, factor in factors.items()), *after)
        for before, found, after in rows
    ]
    return page.table((*first, *headings, *last), lines)


def text(description: str, card: Mapping[str, Any]) -> str:
    """Return a card for people, in Markdown."""
    known = card["environments"]
    rows = [((name, str(entry["worlds"])), entry["results"], ()) for name, entry in known.items()]
    meaning = "; ".join(f"{word}: {words}" for word, words in EXPLANATIONS.items())
    commands = dict.fromkeys((entry["command"], entry["coopenv"]) for entry in known.values())
    parts = [
        f"# {card['agent']}",
        " ".join(description.split()),
        figure_table(("environment", "worlds"), rows),
        f"{meaning[0].upper()}{meaning[1:]}. Measured with",
        "\n".join(f"    {command} --write-card  # coopenv {number}" for command, number in commands),
        *(_study_parts(card["study"]) if "study" in card else []),
    ]
    return "\n\n".join(parts) + "\n"


WITHIN = 0.15
"""Seeds whose e95 is at most so much above the best one's count as alike."""


def _study_parts(study: Mapping[str, Any]) -> list[str]:
    """Return parts of Markdown: figures of every seed and of scripted drivers, differences, spread."""
    rows = []
    for seed, entry in study["seeds"].items():
        best = " (best)" if int(seed) == study["best"] else ""
        minutes = f"{entry['runs']['steps'] / 1e6:.1f} M steps, {entry['runs']['cpu_minutes']:.1f} min"
        rows.append(((f"seed {seed}{best}",), entry["results"], (minutes,)))
    rows += [((name,), found, ("",)) for name, found in study["beside"].items()]
    errors = sorted(entry["results"]["e95_m"]["mean"] for entry in study["seeds"].values())
    alike = sum(error <= (1.0 + WITHIN) * errors[0] for error in errors)
    lines = [f"- Best against `{name}`: {_changes_text(found)}." for name, found in study["against"].items()]
    lines.append(
        f"- e95 over seeds: {100 * errors[0]:.1f} to {100 * errors[-1]:.1f} cm; {alike} of {len(errors)} within "
        f"{100 * WITHIN:.0f} % of the least."
    )
    return [
        figure_table(("on the same worlds",), rows, ("trained",)),
        "Minutes are of one core. The best has the highest return by its own reward, in worlds that are not these.",
        "\n".join(lines),
        "Trained with, in this folder,",
        f"    {study['seeds'][str(study['best'])]['runs']['command']}",
    ]


OVERVIEW = ("arrival_rate", "collision_rate", "travel_time_s", "e50_m", "e95_m")
INTRODUCTION = """# Agents

One folder per driver, each with a card; [docs/agents.md](../docs/agents.md) describes the scripted drivers.
`study.toml` lists the learned agents, `train.toml` their settings and arms. `make agents` trains them and writes this
page. It shows the best seed of each agent, chosen by the training reward in other worlds.
"""
LEGEND = """95 % intervals over {worlds} held-out worlds, the same for all agents. e50 and e95: percentiles of
the position error of vehicles under way, from 3 s on. The last column lists the seeds in their order."""


def overview_section(
    environment: str, found: Mapping[str, Mapping[str, Any]], base: str | None, against: Mapping[str, Any]
) -> str:
    """Return the part of the page of agents on one environment.

    Args:
        environment: its name.
        found: cards of studies by agent.
        base: agent that others are compared with, one of these; None: it is not there.
        against: of those others, their changes against it.
    """
    newest = list(found.values())[-1]
    rows = [((name,), known, ("",)) for name, known in newest["study"]["beside"].items()]
    for name, card in found.items():
        errors = ", ".join(f"{100 * error:.1f}" for error in seeds_of(card, "e95_m"))
        rows.append(((f"[`{name}`]({name}/card.md)",), card["environments"][environment]["results"], (errors,)))
    lines = []
    for name, card in found.items():
        others = [f"{other} {_percent(known['e95_m'])}" for other, known in card["study"]["against"].items()]
        lines.append(f"- `{name}`: e95 against {', '.join(others)}.")
    for name, known in against.items():
        change = _changes_text(known, ("e50_m", "e95_m", "travel_time_s"))
        shares = {
            metric: median(seeds_of(found[name], metric)) / median(seeds_of(found[str(base)], metric)) - 1
            for metric in ("e50_m", "e95_m")
        }
        medians = ", ".join(f"{CHANGES[metric]} {100 * share:+.0f} %" for metric, share in shares.items())
        lines.append(f"- `{name}` against `{base}`: {change}; median seed against median seed: {medians}.")
    parts = [
        f"## {environment}",
        figure_table(("agent",), rows, ("e95 of seeds [cm]",), OVERVIEW),
        LEGEND.format(worlds=newest["environments"][environment]["worlds"]),
        "\n".join(lines),
    ]
    return "\n\n".join(parts) + "\n"


def seeds_of(card: Mapping[str, Any], metric: str) -> list[float]:
    """Return a figure of every seed of a study."""
    return [entry["results"][metric]["mean"] for entry in card["study"]["seeds"].values()]
