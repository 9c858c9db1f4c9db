"""`python -m benchmarks.reachable ENV`: what a fleet could reach in single worlds, beside what agents reach there.

For each held-out world, a search finds the actions of all vehicles with which the fleet knows its poses best: the least
95th percentile of the stated deviations of all vehicles, with all arrived in time and without a collision. It starts
from the best one of the agents and tries changes of its actions in copies of the world, by the cross-entropy method. It
knows the world and all covariances, which no vehicle does; the true errors it does not use. The search shows what can
be reached, not that nothing better can.
Source: Rubinstein and Kroese, The Cross-Entropy Method, 2004, chapter 5; with covariance diagonal.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from contextlib import closing
from itertools import count
from typing import NamedTuple

import numpy as np
from rich.console import Console

from coopenv.api.engine import Engine
from coopenv.api.terms.layout import observation_layout
from coopenv.base.errors import CoopenvError
from coopenv.bench.observers.rows import standard_error
from coopenv.estimation import Outcome
from coopenv.evaluation import Episodes, drive, held_out_seeds
from coopenv.policies import Policy, load_agent
from coopenv.policies.base import decide, restart
from coopenv.report.table import Table
from coopenv.runs.console import Progress
from coopenv.scenario import Scenario
from coopenv.scenario.terms import SETTLED_FROM
from coopenv.sources.sources import open_simulation

SEARCH = "search"
AGENTS = ("route_follower", "look_ahead", "team_look_ahead")
KNOT = 1.0
"""s between the knots of a change of actions, which is linear in between."""
SPREAD = 0.3
"""Initial standard deviation of the changes; actions lie in [-1, 1]."""
ELITE, KEPT = 0.1, 0.3
"""Share of the copies whose changes the next ones are drawn from; share of the last mean and deviation that is kept."""
MISSED = 10.0
"""m, what a vehicle that collides or does not arrive costs."""


class Outcomes(NamedTuple):
    """Outcome of a plan in each copy of a world."""

    stated: np.ndarray  # (W,) m, 95th percentile of the stated deviations
    e95: np.ndarray  # (W,) m, of the true position errors
    arrived: np.ndarray  # (W,) share of the vehicles
    collided: np.ndarray  # (W,) likewise

    @property
    def cost(self) -> np.ndarray:
        """(W,) m, what a search minimises."""
        return np.asarray(np.nan_to_num(self.stated, nan=MISSED) + MISSED * (1.0 - self.arrived + self.collided))


class Recorded:
    """A policy whose actions and observed stated deviations are kept."""

    def __init__(self, policy: Policy, scenario: Scenario) -> None:
        self._policy, self._layout = policy, observation_layout(scenario)
        self.actions: list[np.ndarray] = []
        self.std: list[np.ndarray] = []

    def reset(self, mask: np.ndarray) -> None:
        """Begin an episode."""
        restart(self._policy, mask)

    def __call__(self, observations: np.ndarray) -> np.ndarray:
        """Return the policy's actions, (rows, A)."""
        self.std.append(10.0 ** self._layout["position_std"].values(observations)[:, 0])
        self.actions.append(decide(self._policy, observations, len(self._layout.action)))
        return self.actions[-1]


class OpenLoop:
    """A policy that repeats given actions (K, rows, A), and the last ones from then on, whatever it observes."""

    def __init__(self, actions: np.ndarray) -> None:
        self._actions, self._next = actions, 0

    def __call__(self, observations: np.ndarray) -> np.ndarray:
        """Return the next actions, (rows, A)."""
        row = min(self._next, len(self._actions) - 1)
        self._next += 1
        return np.asarray(self._actions[row])


def driven(engine: Engine, policy: Policy, seed: int) -> tuple[Outcomes, np.ndarray]:
    """Drive all copies of a world; return their outcomes, and the actions (K, W, N, A)."""
    scenario, copies = engine.backend.scenario, engine.world.worlds
    recorded = Recorded(policy, scenario)
    episodes = drive(engine, recorded, [seed] * copies)
    actions = np.stack(recorded.actions).reshape(len(recorded.actions), copies, len(scenario.vehicles), -1)
    names = list(scenario.vehicle_names)
    chosen = [names.index(name) for name in episodes.vehicles]
    std = np.stack(recorded.std).reshape(*actions.shape[:3])[:, :, chosen]
    return outcomes(episodes, std), actions


def outcomes(episodes: Episodes, std: np.ndarray) -> Outcomes:
    """Return what episodes led to, from stated deviations (K, W, N) at the beginning of each decision."""
    counted = episodes.under_way & (episodes.time >= SETTLED_FROM)[:, None, None]

    def percentile(values: np.ndarray) -> np.ndarray:
        rows = [values[:, w][counted[:, w]] for w in range(episodes.worlds)]
        return np.array([np.quantile(row, 0.95) if len(row) else np.nan for row in rows])

    arrived = np.mean(episodes.arrivals[-1] > 0, axis=1, where=episodes.present)
    collided = np.mean(episodes.outcome == Outcome.COLLIDED, axis=1, where=episodes.present)
    return Outcomes(percentile(std), percentile(episodes.position_error), arrived, collided)


def searched(engine: Engine, actions: np.ndarray, seed: int, rounds: int, on_round: Callable[[], None]) -> Outcomes:
    """Search from actions (K, N, A) on, in two copies of a world at least; return the best plan's outcome, (1,)."""
    rng, copies, (K, N, A) = np.random.default_rng(seed), engine.world.worlds, actions.shape
    time = np.arange(K) * engine.backend.scenario.ticks_per_decision / engine.backend.scenario.rates.camera
    knots = np.arange(0.0, time[-1] + KNOT, KNOT)
    weights = np.stack([np.interp(time, knots, row) for row in np.eye(len(knots))], axis=1)  # (K, knots)
    mean, std = np.zeros((len(knots), N, A)), np.full((len(knots), N, A), SPREAD)
    best, change = None, mean
    for _ in range(rounds):
        changes = mean + std * rng.standard_normal((copies, *mean.shape))
        changes[0], changes[1] = change, mean
        plans = np.clip(actions[:, None] + np.einsum("tk,wkna->twna", weights, changes), -1.0, 1.0)
        found, _ = driven(engine, OpenLoop(plans.reshape(K, copies * N, A)), seed)
        order = np.argsort(found.cost, kind="stable")
        if best is None or found.cost[order[0]] < best.cost[0]:
            best, change = Outcomes(*(values[order[:1]] for values in found)), changes[order[0]]
        elite = changes[order[: max(2, round(ELITE * copies))]]
        mean = KEPT * mean + (1.0 - KEPT) * elite.mean(axis=0)
        std = KEPT * std + (1.0 - KEPT) * elite.std(axis=0)
        on_round()
    assert best is not None
    return best


def measured(scenario: Scenario, agents: Sequence[str], asked: argparse.Namespace) -> dict[str, Outcomes]:
    """Return the outcomes of the agents and of the search, an entry per world."""
    found = dict[str, list[Outcomes]]()
    with (
        closing(Engine(scenario, 1)) as single,
        closing(Engine(scenario, asked.copies)) as many,
        Progress(Console(stderr=True), "searching", total=asked.worlds * asked.rounds) as progress,
    ):
        done = count(1)
        for seed in held_out_seeds(asked.block, asked.worlds):
            plans = {name: driven(single, load_agent(name, scenario), seed) for name in agents}
            for name, (outcome, _) in plans.items():
                found.setdefault(name, []).append(outcome)
            _, actions = min(plans.values(), key=lambda plan: float(plan[0].cost[0]))
            best = searched(many, actions[:, 0], seed, asked.rounds, lambda: progress.update(next(done)))
            found.setdefault(SEARCH, []).append(best)
    return {name: Outcomes(*map(np.concatenate, zip(*rows, strict=True))) for name, rows in found.items()}


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; return the exit status: 0, or 2 after a mistake in the input."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.reachable", description=__doc__)
    parser.add_argument("environment")
    parser.add_argument("--agents", default=",".join(AGENTS), help=f"to compare (default: {','.join(AGENTS)})")
    parser.add_argument("--worlds", type=int, default=8, help="number of worlds (default: 8)")
    parser.add_argument("--block", type=int, default=40, help="block of held-out seeds (default: 40)")
    parser.add_argument("--copies", type=int, default=128, help="of a world, in each round (default: 128)")
    parser.add_argument("--rounds", type=int, default=40, help="of the search (default: 40)")
    parser.add_argument("--seconds", type=float, help="within which all have to arrive (default: the horizon)")
    asked = parser.parse_args(arguments)
    try:
        if min(asked.worlds, asked.copies, asked.rounds * 2) < 2:
            raise CoopenvError("--worlds and --copies are at least 2, --rounds at least 1")
        overrides = {} if asked.seconds is None else {"horizon": asked.seconds}
        scenario = open_simulation(asked.environment, overrides)
        if "position_std" not in observation_layout(scenario):
            raise CoopenvError(f"{asked.environment}: its observation lacks position_std (group quality)")
        found = measured(scenario, asked.agents.split(","), asked)
    except CoopenvError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    headings = ["stated e95\n[cm]", "e95\n[cm]", "over the\nsearch", "arrived\n[%]", "collided\n[%]"]
    table = Table.of_texts(("",), headings)
    for name, own in found.items():
        shares = 100.0 * own.arrived, 100.0 * own.collided
        values = 100.0 * own.stated, 100.0 * own.e95, own.e95 / found[SEARCH].e95, *shares
        cells = zip(values, (1, 1, 2, 0, 0), strict=True)
        table.add(name, *(f"{v.mean():.{digits}f}\n±{standard_error(v):.{digits}f}" for v, digits in cells))
    console = Console()
    console.print(f"{asked.environment}: mean over {asked.worlds} worlds of block {asked.block}, with standard errors.")
    console.print(table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
