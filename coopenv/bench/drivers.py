"""Score a driver: what share of vehicles arrives, collides, runs out of time, and how well they know where they are."""

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from rich.table import Table

from coopenv.api.parallel_env import CooperativeLocalisationEnv
from coopenv.policies import Policy, act
from coopenv.runs.table import number_table


@dataclass(frozen=True)
class Score:
    """Results over episodes; shares are of all vehicles of all episodes."""

    episodes: int
    arrived: float
    collided: float
    under_way: float
    """Neither when the episode ended."""
    mean_return: float
    """Sum of the rewards of all vehicles, mean over episodes."""
    std_return: float
    median_position_error_m: float
    p95_position_error_m: float


def play(env: CooperativeLocalisationEnv, policy: Policy, seed: int) -> tuple[float, list[str], list[float]]:
    """Drive one episode and return (sum of rewards, outcome per vehicle, position errors in m)."""
    observations, infos = env.reset(seed=seed)
    total, errors, last = 0.0, [], dict(infos)
    while env.agents:
        observations, rewards, _, _, infos = env.step(act(policy, {agent: observations[agent] for agent in env.agents}))
        total += sum(rewards.values())
        last.update(infos)
        errors += [info["position_error"] for info in infos.values()]
    return total, [info["outcome"] for info in last.values()], errors


def score(episodes: Iterator[tuple[float, list[str], list[float]]]) -> Score:
    """Sum up episodes that `play` returned."""
    returns, outcomes, errors = [], Counter[str](), []
    for total, ends, seen in episodes:
        returns.append(total)
        outcomes.update(ends)
        errors += seen
    vehicles = max(1, outcomes.total())
    arrived, collided, under_way = (outcomes[word] / vehicles for word in ("arrived", "collided", "under way"))
    error = float(np.median(errors)), float(np.percentile(errors, 95))
    return Score(len(returns), arrived, collided, under_way, float(np.mean(returns)), float(np.std(returns)), *error)


def score_document(rows: Iterable[tuple[str, str, Score]]) -> list[dict[str, Any]]:
    """Return what `bench agents --json` prints of (driver, environment, score)."""
    return [{"agent": agent, "environment": environment, **asdict(s)} for agent, environment, s in rows]


def score_table(rows: Iterable[tuple[str, str, Score]]) -> Table:
    """Return one row per (driver, environment, score)."""
    outcomes = ("arrived", "collided", "out of\ntime")
    errors = ("median\nerror", "95 %\nerror")
    table = number_table(("agent", "environment"), ("runs", *outcomes, "return", *errors), gap=0)
    for agent, environment, s in rows:
        table.add_row(
            agent,
            environment,
            str(s.episodes),
            *(f"{100 * share:.0f} %" for share in (s.arrived, s.collided, s.under_way)),
            f"{s.mean_return:.1f}±{s.std_return:.1f}",
            f"{s.median_position_error_m:.3f}",
            f"{s.p95_position_error_m:.3f}",
        )
    return table
