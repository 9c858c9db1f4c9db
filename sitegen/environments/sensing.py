"""The value of sensing, or of cooperation: drivers in the same held-out worlds at every setting of what is sensed."""

import hashlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from coopenv.base.errors import CoopenvError
from coopenv.base.files import replace_text
from coopenv.base.format import json_text
from coopenv.base.installation import data_directory, version
from coopenv.bench.cards import OVERVIEW, figures_table
from coopenv.bench.contest import Contest
from coopenv.bench.evaluation import evaluated
from coopenv.evaluation.metrics import SCORE
from coopenv.policies import agents_for
from coopenv.report.templates import rendered
from coopenv.scenario import Scenario

SETTINGS = ("ideal", "sensed", "blind")
"""Values of the key `sensing` of the scenario; all else is equal."""
DRIVERS = ("route_follower", "peek")
"""A driver that looks straight ahead, and one that plans its view."""
TEAM_DRIVERS = ("look_ahead", "team_look_ahead")
"""A driver that plans for itself, and one that plans for the fleet."""
RADIO_OFF, SILENT = "radio off", "silent"
"""The setting without messages, and the folder, in that of a team, of the one that learnt without messages."""
MADE_BY = "python -m sitegen.environments"
"""Command that pages name; the pages of the project still name that of version 0.9."""
SHOWN = ("mean", "ci_low", "ci_high")
KEYS = ("sensing", "agent", "metric", *SHOWN, "n")


def measured_drivers(name: str) -> tuple[str, ...]:
    """Return the drivers by which cooperation, or else sensing, is measured: if both were made for the environment."""
    made = {*agents_for(name)}
    return next((drivers for drivers in (TEAM_DRIVERS, DRIVERS) if {*drivers} <= made), ())


def cooperation_settings(scenario: Scenario) -> dict[str, Mapping[str, Any]]:
    """Return overrides of the scenario by the name of the setting: without bearings to cars, messages, or lies."""
    hidden = {f"vehicles.{i}.marker": (0.0, 0.0, 9.0) for i in range(len(scenario.vehicles))}  # m; above all images
    lies = [i for i, faults in enumerate(scenario.all_faults) if faults.lie.kind != "none"]
    honest = {"no lies": {f"vehicles.{i}.faults.lie.kind": "none" for i in lies}} if lies else {}
    return {"as it is": {}, "cars unseen": hidden, RADIO_OFF: {"v2x.range": 1e-3}, **honest}


def studied(name: str, scenario: Scenario) -> tuple[tuple[str, ...], dict[str, Mapping[str, Any]]]:
    """Return the drivers that are measured, and the overrides of each setting that they are measured at."""
    if measured_drivers(name) == TEAM_DRIVERS:
        learned = [agent for agent in agents_for(name) if agent == f"{name}_team"]
        return (*TEAM_DRIVERS, *learned), cooperation_settings(scenario)
    shared = cooperation_settings(scenario) if sum(scenario.acting) > 1 else {}
    shared.pop("as it is", None)  # equal to "sensed"
    return DRIVERS, {how: {"sensing": how} for how in SETTINGS} | shared


def retrained(name: str, setting: str) -> list[str]:
    """Return the folder of the team that learnt without messages, for the setting without them, if there is one."""
    folder = data_directory("agents") / f"{name}_team" / SILENT
    return [str(folder)] * (setting == RADIO_OFF and folder.is_dir())


def contests(environment: str, scenario: Scenario, worlds: int) -> dict[str, Contest]:
    """Return the drivers that are measured, built, by the name of the setting.

    Raises:
        CoopenvError: one cannot drive here, or nothing is driven.
    """
    name = Path(environment).stem
    drivers, settings = studied(name, scenario)
    return {
        how: Contest.of(environment, overrides, [*drivers, *retrained(name, how)], worlds)
        for how, overrides in settings.items()
    }


def write_figures(
    environment: str, scenario: Scenario, folder: Path, worlds: int, on_progress: Callable[[float, str], None]
) -> None:
    """Measure the value of sensing, or cooperation, in an environment, and write it for the page.

    Both drivers drive in the same held-out worlds at every setting.

    Args:
        environment: name or TOML file.
        scenario: the present scenario.
        folder: of the page.
        worlds: number of worlds.
        on_progress: called with the share that is done, and the driver.
    """
    rows: list[dict[str, Any]] = []
    built = contests(environment, scenario, worlds)
    for place, (how, contest) in enumerate(built.items()):

        def report(done: float, name: str, place: int = place, how: str = how, of: int = len(contest.entrants)) -> None:
            on_progress((place + done / of) / len(built), f"{how}: {name}")

        found = evaluated(contest, report).rows
        rows += [{key: {"sensing": how, **row}[key] for key in KEYS} for row in found if row["metric"] in OVERVIEW]
    value = {"coopenv": version(), "score": SCORE, "worlds": worlds, "scenario": fingerprint(scenario), "rows": rows}
    replace_text(folder / f"{Path(environment).stem}.json", json_text(value))


def read_value_of_sensing(path: Path) -> dict[str, Any] | None:
    """Return the earlier measurement; None without one.

    Raises:
        CoopenvError: the file holds something else.
    """
    if not path.exists():
        return None
    try:
        value: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        if "text" not in value:
            _rows(value)
        kept = {key: value[key] for key in ("coopenv", "worlds", "scenario", "text" if "text" in value else "rows")}
        return {**kept, "score": value.get("score", SCORE if "text" in value else 1)}
    except (OSError, ValueError, KeyError, TypeError) as error:
        why = f"{error} is missing" if isinstance(error, KeyError) else str(error)
        raise CoopenvError(f"{path}: no figures of a page ({why}); --measure makes them anew") from None


def value_of_sensing_text(environment: str, scenario: Scenario, value: Mapping[str, Any]) -> str:
    """Return the figures in Markdown, with the commands that give them; `text` is what a benchmark has written."""
    changed = value["scenario"] != fingerprint(scenario) or value["score"] != SCORE
    if "text" in value:
        note = "*The environment or the score has changed since these figures were measured.*\n\n" if changed else ""
        return f"{note}{value['text']}"
    rows = _rows(value)
    settings = {how for how, _ in rows}
    team, shared = measured_drivers(environment) == TEAM_DRIVERS, RADIO_OFF in settings
    return rendered(
        "sensing.md.j2",
        "sitegen.environments",
        "",
        environment=environment,
        team=team,
        shared=shared,
        honest="no lies" in settings,
        drivers=studied(environment, scenario)[0],
        silent=(RADIO_OFF, SILENT) in rows,
        table=figures_table(("setting" if team or shared else "sensing", "agent"), rows.items(), OVERVIEW),
        worlds=value["worlds"],
        coopenv=value["coopenv"],
        changed=changed,
        made_by=MADE_BY,
    ).strip()


def _rows(value: Mapping[str, Any]) -> dict[tuple[str, str], dict[str, Any]]:
    """Return the figures by setting and agent."""
    found = {(row["sensing"], row["agent"], row["metric"]): row for row in value["rows"]}
    return {
        (how, agent): {metric: {key: found[how, agent, metric][key] for key in SHOWN} for metric in OVERVIEW}
        for how, agent, first in found
        if first == OVERVIEW[0]
    }


def fingerprint(scenario: Scenario) -> str:
    """Return a digest of a scenario's settings without defaults; figures depend neither on texts nor on the reward."""
    unused = {"title", "description", "source", "reward"}
    settings = scenario.model_dump(mode="json", exclude_unset=True, exclude=unused)
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:16]
