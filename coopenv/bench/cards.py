"""Cards of agents: their figures in held-out worlds, JSON for programs, Markdown for people."""

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from coopenv.base.errors import CoopenvError
from coopenv.base.files import check_file, replace_text
from coopenv.base.format import json_text
from coopenv.base.installation import is_installed, version
from coopenv.bench.contest import IDEAL, Contest, Entrant
from coopenv.bench.evaluation import COLUMNS, EXPLANATIONS, Evaluation, cell, figures, percent
from coopenv.evaluation.metrics import SCORE
from coopenv.policies.loader import CARD_FILES
from coopenv.report.table import markdown
from coopenv.report.templates import rendered

JSON_FILE, TEXT_FILE = CARD_FILES


def carded(contest: Contest) -> list[tuple[Entrant, Path]]:
    """Return the drivers that get a card, with their folders, each of which has a readable card or none.

    Raises:
        CoopenvError: an agent has no folder or one of the installed wheel, or its card cannot be read or written.
    """
    found = []
    for entrant in contest.entrants:
        folder = entrant.agent.folder
        if folder is None:
            raise CoopenvError(f"--write-card: {entrant.name} is a place in code; a card needs an agent's folder")
        if is_installed(folder):
            why = f"{entrant.name} belongs to the installation; copy {folder} and name the copy in --agents"
            raise CoopenvError(f"--write-card: {why}")
        if entrant.name != IDEAL:
            read(folder)
            for name in CARD_FILES:
                check_file(folder / name)
            found.append((entrant, folder))
    return found


def read(folder: Path) -> dict[str, Any]:
    """Return the contents of `card.json`, results by environment under `environments`; without a card, no results.

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


def write(evaluation: Evaluation, cards: Iterable[tuple[Entrant, Path]], command: str) -> list[Path]:
    """Write the results of an evaluation to cards, see `carded`; results of other environments stay."""
    written = []
    for entrant, folder in cards:
        card = read(folder)
        known = card["environments"]
        results = figures(evaluation.results[entrant.name])
        known[evaluation.environment] = measured(command, evaluation.worlds, evaluation.block, results)
        card |= {"agent": entrant.name, "kind": entrant.kind, "environments": dict(sorted(known.items()))}
        written.append(save(folder, entrant.agent.description, card))
    return written


def measured(command: str, worlds: int, block: int, results: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entry of an environment in a card."""
    about = {"command": command, "coopenv": version(), "score": SCORE, "worlds": worlds, "seed_block": block}
    return {**about, "results": results}


def save(folder: Path, description: str, card: Mapping[str, Any]) -> Path:
    """Write a card to an agent's folder, and return the path of the one for people."""
    replace_text(folder / JSON_FILE, json_text(card))
    entries, study = card["environments"], card.get("study")
    worlds = [((name, str(entry["worlds"])), entry["results"]) for name, entry in entries.items()]
    text = rendered(
        "card.md.j2",
        card={"study": None, **card},
        old=any(entry.get("score", 1) < SCORE for entry in entries.values()),
        description=" ".join(description.split()),
        results=figures_table(("environment", "worlds"), worlds),
        trained="" if study is None else _study_table(study),
        explanations=EXPLANATIONS,
        percent=percent,
    )
    replace_text(folder / TEXT_FILE, text)
    return folder / TEXT_FILE


def _study_table(study: Mapping[str, Any]) -> str:
    """Return the figures of every seed of a study, and of drivers beside them, in Markdown."""
    rows: list[tuple[Any, ...]] = []
    for seed, entry in study["seeds"].items():
        best = " (best)" if int(seed) == study["best"] else ""
        took = f"{entry['runs']['steps'] / 1e6:.1f} M steps, {entry['runs']['cpu_minutes']:.1f} min"
        rows.append(((f"seed {seed}{best}",), entry["results"], took))
    rows += [((name,), results, "") for name, results in study["beside"].items()]
    return figures_table(("on the same worlds",), rows, last=("trained",))


OVERVIEW = ("arrival_rate", "collision_rate", "travel_time_s", "e50_m", "e95_m")


def figures_table(
    names: Sequence[str],
    rows: Iterable[tuple[Any, ...]],
    metrics: Sequence[str] = tuple(COLUMNS),
    last: Sequence[str] = (),
) -> str:
    """Return figures of cards in Markdown.

    Args:
        names: headings of the columns before the figures.
        rows: cells of these columns, figures by metric, and the cells of further columns.
        metrics: metrics that are shown.
        last: headings of the further columns.
    """
    heads = [*names, *(COLUMNS[metric][0].strip().replace("\n", " ") for metric in metrics), *last]
    cells = ((first, [cell(found[m], COLUMNS[m][1]) for m in metrics], rest) for first, found, *rest in rows)
    return markdown(heads, [(*first, *shown, *rest) for first, shown, rest in cells])
