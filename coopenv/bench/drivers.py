"""Score a driver: what share of vehicles arrives, collides, runs out of time, and how well they know where they are."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from rich.table import Table

from coopenv.api.parallel_env import CooperativeLocalisationEnv
from coopenv.policies import Policy, act
from coopenv.runs.table import number_table


@dataclass(frozen=True)
class Score:
    """Results of a driver in an environment over episodes; shares are of all vehicles of all episodes."""

    agent: str
    environment: str
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


def score(agent: str, environment: str, episodes: Iterator[tuple[float, list[str], list[float]]]) -> Score:
    """Sum up episodes that `play` returned."""
    returns, outcomes, errors = [], Counter[str](), []
    for total, ends, seen in episodes:
        returns.append(total)
        outcomes.update(ends)
        errors += seen
    vehicles = max(1, outcomes.total())
    arrived, collided, under_way = (outcomes[word] / vehicles for word in ("arrived", "collided", "under way"))
    error = float(np.median(errors)), float(np.percentile(errors, 95))
    shares, returned = (arrived, collided, under_way), (float(np.mean(returns)), float(np.std(returns)))
    return Score(agent, environment, len(returns), *shares, *returned, *error)


def score_table(scores: Sequence[Score]) -> Table:
    """Return one row per driver and environment."""
    outcomes, errors = ("arrived", "collided", "out of\ntime"), ("median\nerror", "95 %\nerror")
    table = number_table(("agent", "environment"), ("runs", *outcomes, "return", *errors), gap=0)
    for s in scores:
        shares = (f"{100 * share:.0f} %" for share in (s.arrived, s.collided, s.under_way))
        far = (f"{error:.3f}" for error in (s.median_position_error_m, s.p95_position_error_m))
        table.add_row(s.agent, s.environment, str(s.episodes), *shares, f"{s.mean_return:.1f}±{s.std_return:.1f}", *far)
    return table
