"""`python -m benchmarks.teams ENV`: is a learned team ahead of the rule with the same information, and of the planners?

Drivers drive in the same held-out worlds. The score is the mean of the scored position errors from 3 s on, in which a
lost vehicle counts as 1 m (`coopenv.evaluation.metrics.scored_errors`). Differences are paired by world. The team also
drives with some fields of its observation at 0, which shows what it reads and not what a team learnt without them could
do. `--page docs/environments` writes the table to the file that the environment's page shows.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.options import at_least
from coopenv import load_scenario
from coopenv.api.engine import Engine
from coopenv.api.terms.layout import observation_layout
from coopenv.base.errors import CoopenvError
from coopenv.base.files import replace_text
from coopenv.base.format import json_text
from coopenv.base.installation import version
from coopenv.estimation import Outcome
from coopenv.evaluation import Episodes, drive, held_out_seeds
from coopenv.evaluation.metrics import scored_errors
from coopenv.policies import Policy, find_agent, load_agent, restart
from coopenv.report.table import markdown
from coopenv.scenario import Scenario
from sitegen.environments.sensing import fingerprint

DRIVERS = ("route_follower", "look_ahead", "team_look_ahead")
"""Drivers beside the rule and the team."""
BLOCK = 411
"""Block of held-out seeds on which neither rule nor team was tuned."""
ABLATIONS = {
    "without messages": ("message_position", "message_forward", "message_mask", "message_age", "message_std"),
    "without map": ("map_position", "map_in_view", "map_age"),
}
"""Fields that are 0, by the name of the row."""


def mean_errors(found: Episodes) -> np.ndarray:
    """Return the mean of the scored errors, m, of each world, (W,)."""
    errors, world = scored_errors(found)
    return np.asarray(np.bincount(world, errors, found.worlds) / np.bincount(world, minlength=found.worlds))


class Blanked:
    """A policy that reads 0 in some fields of its observation."""

    def __init__(self, scenario: Scenario, policy: Policy, fields: Sequence[str]) -> None:
        """Find the columns of the fields that the scenario observes."""
        layout = observation_layout(scenario)
        self._policy = policy
        self._columns = [k for name in fields if name in layout for k in range(layout[name].start, layout[name].stop)]

    def reset(self, mask: np.ndarray) -> None:
        """Begin new episodes in the rows of a mask."""
        restart(self._policy, mask)

    def __call__(self, observations: np.ndarray) -> np.ndarray:
        """Return the actions (rows, A) of the policy."""
        seen = np.array(observations)
        seen[:, self._columns] = 0.0
        return self._policy(seen)


def policies(environment: str, scenario: Scenario, others: Sequence[str]) -> dict[str, Policy]:
    """Return rule, planners, other agents, and the team with and without some fields, by the name of their row.

    Raises:
        CoopenvError: there is no such agent, or it cannot drive here.
    """
    rule, team = f"{environment}_rule", f"{environment}_team"
    found = {find_agent(name).name: load_agent(name, scenario) for name in (rule, *DRIVERS, *others, team)}
    for how, fields in ABLATIONS.items():
        found[f"{team}, {how}"] = Blanked(scenario, load_agent(team, scenario), fields)
    return found


def report(environment: str, worlds: int, block: int, others: Sequence[str]) -> str:
    """Drive, and return the table in Markdown, with the command that gives it."""
    scenario = load_scenario(environment)
    engine, seeds, rows, rule = Engine(scenario, worlds), held_out_seeds(block, worlds), [], None
    for name, policy in policies(environment, scenario, others).items():
        found = drive(engine, policy, seeds)
        errors = 100.0 * mean_errors(found)
        rule = errors if rule is None else rule
        shares = (found.arrivals[-1] > 0, found.outcome == Outcome.COLLIDED)
        change = _with_error(errors - rule) if np.any(errors != rule) else ""
        rows.append([name, _with_error(errors), change, *(f"{100.0 * share.mean():.0f}" for share in shares)])
    columns = ["driver", "mean error [cm]", f"minus `{environment}_rule` [cm]", "arrived [%]", "collided [%]"]
    card = find_agent(f"{environment}_team").network
    alone = f"; without messages `{card.alone}` drives the cars" if card and card.alone else ""
    command = f"python -m benchmarks.teams {environment} --worlds {worlds} --block {block}"
    return "\n\n".join(
        [
            "## What learning is worth",
            f"`{environment}_rule` is a hand-written rule whose constants a random search has tuned; it reads what "
            f"`{environment}_team` reads, a vehicle's own observation. The team has no memory. `team_look_ahead` "
            "reads all covariances. Mean of the position error from 3 s on, at most 1 m, which is that of a lost "
            "vehicle, and the difference in "
            f"the same worlds, over {worlds} held-out worlds of block {block}, with standard errors. In the last rows, "
            "fields of the observation read 0, for which the team was not trained: they show what it reads, not what "
            f"a team that is trained without these fields can do{alone}.",
            markdown(columns, rows),
            f"```\n{command}  # coopenv {version()}\n```",
        ]
    )


def _with_error(values: np.ndarray) -> str:
    return f"{values.mean():.1f} ({values.std(ddof=1) / np.sqrt(len(values)):.1f})"


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, and print the table; return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.teams", description=__doc__)
    parser.add_argument("environment", metavar="ENV", help="with agents ENV_rule and ENV_team")
    parser.add_argument("--others", default=[], nargs="*", metavar="AGENT", help="further drivers, such as your rule")
    parser.add_argument("--worlds", type=at_least(2), default=64, help="held-out worlds (default: 64)")
    parser.add_argument("--block", type=int, default=BLOCK, help=f"block of their seeds (default: {BLOCK})")
    parser.add_argument("--page", type=Path, help="folder of the environments' pages")
    asked = parser.parse_args(arguments)
    try:
        text = report(asked.environment, asked.worlds, asked.block, asked.others)
    except CoopenvError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(text)
    if asked.page:
        scene = fingerprint(load_scenario(asked.environment))
        value = {"coopenv": version(), "worlds": asked.worlds, "scenario": scene, "text": text}
        replace_text(asked.page / f"{asked.environment}.json", json_text(value))
    return 0


if __name__ == "__main__":
    sys.exit(main())
