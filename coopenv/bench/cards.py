"""The card of an agent: its figures per environment, as `card.json` for programs and `card.md` for people."""

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from coopenv.base.errors import CoopenvError
from coopenv.base.files import check_file, replace_text
from coopenv.base.format import NONE, json_text
from coopenv.base.installation import version
from coopenv.bench.contest import IDEAL, Entrant, Evaluation, contest, enter
from coopenv.evaluation import Difference, Result
from coopenv.policies import agents_for
from coopenv.policies.loader import CARD_FILES
from coopenv.runs.console import number_table
from coopenv.runs.page import plain, table
from coopenv.scenario import Scenario

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
COMPARED = ("travel_time_s", "e50_m", "e95_m", "orientation_e95_deg")


def results_table(evaluation: Evaluation) -> Table:
    """Return one row per driver: figures, with their intervals below."""
    table = number_table(("agent",), [heading for heading, _ in COLUMNS.values()], gap=0)
    for name, results in evaluation.results.items():
        known = {result.metric: result for result in results}
        table.add_row(name, *(_cell(known[metric], factor) for metric, (_, factor) in COLUMNS.items()))
    return table


def differences_table(evaluation: Evaluation) -> Table:
    """Return one row per driver but the reference: relative differences, with their intervals below."""
    headings = [COLUMNS[metric][0].split("\n")[0] for metric in COMPARED]
    headings[-1] += " (deg)"
    table = number_table((f"against {evaluation.reference}",), [f"{heading}\n[%]" for heading in headings], gap=0)
    for name, differences in evaluation.differences.items():
        known = {difference.metric: difference for difference in differences}
        table.add_row(name, *(_change(known[metric]) for metric in COMPARED))
    return table


def shown(mean: float, low: float, high: float) -> tuple[str, str, str]:
    """Return a figure and the ends of its interval with as many decimals as the first digit of its width needs."""
    width = high - low
    decimals = 1
    if np.isfinite(width) and width > 0.0:
        decimals = int(np.clip(-np.floor(np.log10(width)), 0, 2))
    first, second, third = (f"{v:z.{decimals}f}" if np.isfinite(v) else NONE for v in (mean, low, high))
    return first, second, third


def cell(result: Mapping[str, Any], factor: float) -> str:
    """Return a figure of a file, `mean` with `ci_low` and `ci_high`, with its interval in brackets."""
    values = [float("nan") if result[key] is None else factor * result[key] for key in ("mean", "ci_low", "ci_high")]
    mean, low, high = shown(*values)
    return NONE if mean == NONE else f"{mean} [{low}, {high}]"


def _cell(result: Result, factor: float) -> str:
    mean, low, high = shown(factor * result.mean, factor * result.ci_low, factor * result.ci_high)
    return mean if low == NONE else f"{mean}\n{low}..{high}"


def _change(difference: Difference) -> str:
    percent = [100 * v for v in (difference.relative, difference.relative_ci_low, difference.relative_ci_high)]
    mean, low, high = (text if text.startswith("-") else f"+{text}" for text in shown(*percent))
    return f"{mean}\n{low}..{high}" if np.isfinite(percent[1]) else mean


EXPLANATIONS = {
    "intervals": "95 %, bootstrap over worlds",
    "e50, e95": "median and 95th percentile of the error of vehicles under way, from 3 s on",
    "few": "share of that time with fewer than three targets in view",
    "return": "sum of the rewards of a vehicle",
}
"""What the words of the tables mean."""


WITHIN = 0.15
"""Seeds whose e95 is at most so much above the best one's count as alike."""


def seeds_section(study: dict[str, Any]) -> list[str]:
    """Return lines of Markdown: figures of every seed and of scripted drivers, differences, spread."""
    headings = [heading.strip().replace("\n", " ") for heading, _ in COLUMNS.values()]
    lines = [f"| on the same worlds | {' | '.join(headings)} | trained |", "|---" * (len(headings) + 2) + "|"]
    for seed, entry in study["seeds"].items():
        best = " (best)" if int(seed) == study["best"] else ""
        minutes = f"{entry['runs']['steps'] / 1e6:.1f} M steps, {entry['runs']['cpu_minutes']:.1f} min"
        lines.append(_row(f"seed {seed}{best}", entry["results"], minutes))
    lines += [_row(name, figures, "") for name, figures in study["beside"].items()]
    lines += [
        "",
        "Minutes are of one core. The best has the highest return by its own reward, in worlds that are not these.",
        "",
    ]
    for name, changes in study["against"].items():
        figures = ", ".join(f"{word} {percent(changes[metric])}" for metric, word in CHANGES.items())
        lines.append(f"- Best against `{name}`: {figures}.")
    command = study["seeds"][str(study["best"])]["runs"]["command"]
    lines += [f"- {_spread(study)}", "", "Trained with, in this folder,", "", f"    {command}"]
    return lines


CHANGES = {"e95_m": "e95", "e50_m": "e50", "travel_time_s": "travel time"}


def _row(name: str, figures: dict[str, Any], trained: str) -> str:
    cells = [cell(figures[metric], factor) for metric, (_, factor) in COLUMNS.items()]
    return f"| {name} | {' | '.join(cells)} | {trained} |"


def percent(change: dict[str, float]) -> str:
    """Return a relative difference and its interval, in percent."""
    mean, low, high = shown(*(100.0 * change[key] for key in ("relative", "ci_low", "ci_high")))
    return f"{mean if mean.startswith('-') else '+' + mean} [{low}, {high}] %"


def _spread(study: dict[str, Any]) -> str:
    errors = sorted(entry["results"]["e95_m"]["mean"] for entry in study["seeds"].values())
    alike = sum(error <= (1.0 + WITHIN) * errors[0] for error in errors)
    span = f"e95 over seeds: {100 * errors[0]:.1f} to {100 * errors[-1]:.1f} cm"
    return f"{span}; {alike} of {len(errors)} within {100 * WITHIN:.0f} % of the least."


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
        rows = [row for row in evaluation.rows() if row["agent"] == entrant.name]
        known = card["environments"]
        known[evaluation.environment] = {
            "command": command,
            "coopenv": version(),
            "worlds": evaluation.worlds,
            "seed_block": evaluation.block,
            "results": {row["metric"]: {key: row[key] for key in ("mean", "ci_low", "ci_high", "n")} for row in rows},
        }
        card |= {"agent": entrant.name, "kind": entrant.kind, "environments": dict(sorted(known.items()))}
        replace_text(folder / JSON_FILE, json_text(card))
        replace_text(folder / TEXT_FILE, text(entrant.agent.description, card))
        written.append(folder / TEXT_FILE)
    return written


def text(description: str, card: dict[str, Any]) -> str:
    """Return a card for people, in Markdown."""
    headings = [heading.strip().replace("\n", " ") for heading, _ in COLUMNS.values()]
    lines = [f"# {card['agent']}", "", " ".join(description.split()), ""]
    lines += [f"| environment | worlds | {' | '.join(headings)} |", "|---" * (len(headings) + 2) + "|"]
    for name, entry in card["environments"].items():
        cells = [cell(entry["results"][metric], factor) for metric, (_, factor) in COLUMNS.items()]
        lines.append(f"| {name} | {entry['worlds']} | {' | '.join(cells)} |")
    meaning = "; ".join(f"{word}: {words}" for word, words in EXPLANATIONS.items())
    lines += ["", f"{meaning[0].upper()}{meaning[1:]}. Measured with", ""]
    commands = dict.fromkeys((entry["command"], entry["coopenv"]) for entry in card["environments"].values())
    lines += [f"    {command} --write-card  # coopenv {number}" for command, number in commands]
    if "study" in card:
        lines += ["", *seeds_section(card["study"])]
    return "\n".join(lines) + "\n"


SETTINGS = ("ideal", "sensed", "blind")
"""Values of the key `sensing` of the scenario; all else is equal."""
DRIVERS = ("route_follower", "peek")
"""A driver that looks straight ahead, and one that plans its view."""
METRICS = ("arrival_rate", "collision_rate", "travel_time_s", "e50_m", "e95_m")
KEYS = ("sensing", "agent", "metric", "mean", "ci_low", "ci_high", "n")


def has_value_of_sensing(name: str) -> bool:
    """Return whether the value of sensing can be measured: both drivers were made for the environment."""
    return {*DRIVERS} <= {*agents_for(name)}


def entrants(environment: str, sensing: str = "sensed") -> list[Entrant]:
    """Return the drivers at a setting of `sensing`, built.

    Raises:
        CoopenvError: one cannot drive here, or nothing is driven.
    """
    return enter(environment, Path(environment).stem, {"sensing": sensing}, DRIVERS, ideal=False)


def measure_value_of_sensing(
    environment: str, scenario: Scenario, worlds: int, on_progress: Callable[[float, str], None]
) -> dict[str, Any]:
    """Let both drivers drive in the same held-out worlds at every setting of `sensing`.

    Args:
        environment: name or TOML file.
        scenario: what it is now.
        worlds: how many.
        on_progress: called with the share that is done, and the driver.

    Returns:
        Plain data, as `read_value_of_sensing` reads it.
    """
    rows: list[dict[str, Any]] = []
    for place, how in enumerate(SETTINGS):

        def report(done: float, name: str, place: int = place, how: str = how) -> None:
            on_progress((place + done / len(DRIVERS)) / len(SETTINGS), f"{how}: {name}")

        found = contest(Path(environment).stem, entrants(environment, how), worlds, 0, report).rows()
        rows += [{key: {"sensing": how, **row}[key] for key in KEYS} for row in found if row["metric"] in METRICS]
    return {"coopenv": version(), "worlds": worlds, "scenario": fingerprint(scenario), "rows": rows}


def read_value_of_sensing(path: Path) -> dict[str, Any] | None:
    """Return what was measured earlier; None where nothing was.

    Raises:
        CoopenvError: the file holds something else.
    """
    if not path.exists():
        return None
    try:
        value: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        _by_place(value)
        return {key: value[key] for key in ("coopenv", "worlds", "scenario", "rows")}
    except (OSError, ValueError, KeyError, TypeError) as error:
        why = f"{error} is missing" if isinstance(error, KeyError) else str(error)
        raise CoopenvError(f"{path}: no figures of a page ({why}); --measure makes them anew") from None


def value_of_sensing_text(environment: str, scenario: Scenario, value: Mapping[str, Any]) -> str:
    """Return the figures in Markdown, with the commands that give them."""
    cells = _by_place(value)
    headings = [COLUMNS[metric][0].strip().replace("\n", " ") for metric in METRICS]
    rows = [(how, agent, *(cells[how, agent, metric] for metric in METRICS)) for how in SETTINGS for agent in DRIVERS]
    worlds = value["worlds"]
    contest = f"coopenv evaluate {environment} --agents {','.join(DRIVERS)} --worlds {worlds} --set sensing=blind"
    parts = [
        "Everything else being equal, `sensing` says whether every target is measured in every frame (`ideal`), what "
        "the camera sees (`sensed`), or nothing (`blind`).",
        table(("sensing", "agent", *headings), rows),
        f"Over {worlds} held-out worlds, with 95 % intervals (bootstrap over worlds); e50 and e95 of the position "
        "error of vehicles under way, from 3 s on.",
        f"```\ncoopenv page {environment} --measure --worlds {worlds}  # coopenv {value['coopenv']}\n"
        f"{contest}  # a third of it\n```",
    ]
    if value["scenario"] != fingerprint(scenario):
        parts.insert(0, "*The environment has changed since these figures were measured.*")
    return "\n\n".join(plain(part) if part[0] not in "`|" else part for part in parts)


def _by_place(value: Mapping[str, Any]) -> dict[tuple[str, str, str], str]:
    """Return the cells of the table by sensing, agent and metric."""
    found = {(row["sensing"], row["agent"], row["metric"]): row for row in value["rows"]}
    keys = [(how, agent, metric) for how in SETTINGS for agent in DRIVERS for metric in METRICS]
    return {key: cell(found[key], COLUMNS[key[2]][1]) for key in keys}


def fingerprint(scenario: Scenario) -> str:
    """Return a digest of a scenario's settings, without its texts and without defaults."""
    settings = scenario.model_dump(mode="json", exclude_unset=True, exclude={"title", "description", "source"})
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:16]
