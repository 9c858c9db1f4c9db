"""The card of an agent: its figures per environment, as `card.json` for programs and `card.md` for people."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from coopenv.base.errors import CoopenvError
from coopenv.base.files import check_file, replace_text
from coopenv.base.format import json_text
from coopenv.base.installation import version
from coopenv.bench.agents.contest import IDEAL, Entrant, Evaluation
from coopenv.bench.agents.seeds_section import seeds_section
from coopenv.bench.agents.table import COLUMNS, EXPLANATIONS, cell
from coopenv.policies.loader import CARD_FILES

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
