"""The agent of a group of runs: its best seed, and the card that tells of all of them."""

import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import tomlkit

from coopenv.base.files import replace_text
from coopenv.base.format import json_text
from coopenv.base.installation import version
from coopenv.bench.agents import cards
from coopenv.bench.learning.judge import REPORTED, Judge
from coopenv.bench.learning.study import Group, Run, Study
from coopenv.bench.learning.work import is_finished
from coopenv.evaluation import Difference, Result
from coopenv.policies.loader import AGENT_FILE
from coopenv.training.settings import SETTINGS_FILE

BASELINES = ("route_follower", "peek", "look_ahead")
COMPARED = ("arrival_rate", "collision_rate", "travel_time_s", "e50_m", "e95_m")


def finished_groups(study: Study, folder: Path) -> dict[Group, list[Run]]:
    """Return the runs that are finished, as study and environments are now, of each group that has any."""
    done = {group: [Run(group, seed) for seed in study.seeds] for group in study.groups}
    done = {group: [run for run in runs if is_finished(study, run, folder)] for group, runs in done.items()}
    return {group: runs for group, runs in done.items() if runs}


def is_told(group: Group, runs: Sequence[Run], folder: Path) -> bool:
    """Return whether a group has a card that tells of just these finished runs."""
    seeds = cards.read(folder / group.name).get("study", {}).get("seeds", {})
    told = {int(seed): entry["runs"]["sha256"] for seed, entry in seeds.items()}
    return told == {run.seed: _trained(folder / run.folder)["sha256"] for run in runs}


def write(study: Study, group: Group, finished: Sequence[Run], folder: Path, judge: Judge) -> None:
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
    replace_text(place / cards.JSON_FILE, json_text(card))
    replace_text(place / cards.TEXT_FILE, cards.text(description, card))


def _trained(place: Path) -> dict[str, Any]:
    """Return what an agent's folder says of its training."""
    document = tomllib.loads((place / AGENT_FILE).read_text(encoding="utf-8"))
    training = document["training"]
    told = {key: training[key] for key in ("steps", "cpu_minutes", "command")}
    return {"sha256": document["network"]["sha256"], **told}


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
