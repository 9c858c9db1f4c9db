"""What sensing is worth in an environment: the same drivers where everything is seen, as it is, and blind."""

import hashlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from coopenv.base.errors import CoopenvError
from coopenv.base.installation import version
from coopenv.bench.agents.contest import Entrant, contest, enter
from coopenv.bench.agents.table import COLUMNS, cell
from coopenv.policies import agents_for
from coopenv.runs.markdown import plain, table
from coopenv.scenario import Scenario

SETTINGS = ("ideal", "sensed", "blind")
"""The positions of the dial, the scenario's key `sensing`; all else is equal."""
DRIVERS = ("route_follower", "peek")
"""Who does not care where it looks, and who does."""
METRICS = ("arrival_rate", "collision_rate", "travel_time_s", "e50_m", "e95_m")
KEYS = ("sensing", "agent", "metric", "mean", "ci_low", "ci_high", "n")


def has_dial(name: str) -> bool:
    """Return whether an environment is there to learn to look: both drivers were made for it."""
    return {*DRIVERS} <= {*agents_for(name)}


def entrants(environment: str, sensing: str = "sensed") -> list[Entrant]:
    """Return the drivers at a position of the dial, built.

    Raises:
        CoopenvError: one cannot drive here, or nothing is driven.
    """
    return enter(environment, Path(environment).stem, {"sensing": sensing}, DRIVERS, ideal=False)


def measure_dial(
    environment: str, scenario: Scenario, worlds: int, on_progress: Callable[[float, str], None]
) -> dict[str, Any]:
    """Let both drivers drive in the same held-out worlds at every position of the dial.

    Args:
        environment: name or TOML file.
        scenario: what it is now.
        worlds: how many.
        on_progress: called with the share that is done, and who drives.

    Returns:
        Plain data, as `read_dial` reads it.
    """
    rows: list[dict[str, Any]] = []
    for place, how in enumerate(SETTINGS):

        def told(done: float, name: str, place: int = place, how: str = how) -> None:
            on_progress((place + done / len(DRIVERS)) / len(SETTINGS), f"{how}: {name}")

        found = contest(Path(environment).stem, entrants(environment, how), worlds, 0, told).rows()
        rows += [{key: {"sensing": how, **row}[key] for key in KEYS} for row in found if row["metric"] in METRICS]
    return {"coopenv": version(), "worlds": worlds, "scenario": fingerprint(scenario), "rows": rows}


def read_dial(path: Path) -> dict[str, Any] | None:
    """Return what was measured earlier; None where nothing was.

    Raises:
        CoopenvError: the file holds something else.
    """
    if not path.exists():
        return None
    try:
        dial: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        _by_place(dial)
        return {key: dial[key] for key in ("coopenv", "worlds", "scenario", "rows")}
    except (OSError, ValueError, KeyError, TypeError) as error:
        why = f"{error} is missing" if isinstance(error, KeyError) else str(error)
        raise CoopenvError(f"{path}: no figures of a page ({why}); --measure makes them anew") from None


def dial_text(environment: str, scenario: Scenario, dial: Mapping[str, Any]) -> str:
    """Return the figures in Markdown, with the commands that give them."""
    cells = _by_place(dial)
    headings = [COLUMNS[metric][0].strip().replace("\n", " ") for metric in METRICS]
    rows = [(how, agent, *(cells[how, agent, metric] for metric in METRICS)) for how in SETTINGS for agent in DRIVERS]
    worlds = dial["worlds"]
    contest = f"coopenv evaluate {environment} --agents {','.join(DRIVERS)} --worlds {worlds} --set sensing=blind"
    parts = [
        "Everything else being equal, `sensing` says whether every target is measured in every frame (`ideal`), what "
        "the camera sees (`sensed`), or nothing (`blind`).",
        table(("sensing", "agent", *headings), rows),
        f"Over {worlds} held-out worlds, with 95 % intervals (bootstrap over worlds); e50 and e95 of the position "
        "error of vehicles under way, from 3 s on.",
        f"```\ncoopenv page {environment} --measure --worlds {worlds}  # coopenv {dial['coopenv']}\n"
        f"{contest}  # a third of it\n```",
    ]
    if dial["scenario"] != fingerprint(scenario):
        parts.insert(0, "*The environment has changed since these figures were measured.*")
    return "\n\n".join(plain(part) if part[0] not in "`|" else part for part in parts)


def _by_place(dial: Mapping[str, Any]) -> dict[tuple[str, str, str], str]:
    """Return the cells of the table by sensing, agent and metric."""
    found = {(row["sensing"], row["agent"], row["metric"]): row for row in dial["rows"]}
    keys = [(how, agent, metric) for how in SETTINGS for agent in DRIVERS for metric in METRICS]
    return {key: cell(found[key], COLUMNS[key[2]][1]) for key in keys}


def fingerprint(scenario: Scenario) -> str:
    """Return a digest of what a scenario says, its words apart; settings that it leaves to the default do not count."""
    said = scenario.model_dump(mode="json", exclude_unset=True, exclude={"title", "description", "source"})
    return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()[:16]
