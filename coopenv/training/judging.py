"""How well a policy drives on held-out maps, with 95 % intervals."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from coopenv.api.terms.layout import action_fields
from coopenv.api.vector_env import CooperativeVectorEnv
from coopenv.estimation.outcomes import Outcome
from coopenv.policies import Policy, decide, restart
from coopenv.scenario import Scenario

SETTLED_AFTER = 3.0
"""s after which position errors count: before, the initial error decays whatever a driver does."""
HELD_OUT = 2**31
"""First seed of the maps that no training sees: those of training are smaller."""
RESAMPLES = 200


@dataclass(frozen=True)
class Figure:
    """A mean over worlds, and where it lies with 95 % confidence (bootstrap over worlds, Efron 1979)."""

    mean: float
    ci_low: float
    ci_high: float


def judge(policy: Policy, scenario: Scenario, name: str, worlds: int, threads: int | None = None) -> dict[str, Figure]:
    """Drive one episode per vehicle of held-out worlds.

    Args:
        policy: of the vehicles.
        scenario: environment.
        name: of the environment.
        worlds: how many.
        threads: shares of the batch.

    Returns:
        `return` (per vehicle), `arrival_rate`, `collision_rate`, `travel_time_s` (of those that arrived), and `e50_m`
        and `e95_m`, the median and 95th percentile of the true position error after 3 s.
    """
    env = CooperativeVectorEnv(scenario, name, num_worlds=worlds, autoreset="disabled", threads=threads)
    try:
        return _figures(*_driven(env, policy))
    finally:
        env.close()


def _driven(env: CooperativeVectorEnv, policy: Policy) -> tuple[dict[str, np.ndarray], list[np.ndarray]]:
    """Return values per vehicle, (W, N), and the position errors that count of each world."""
    observations, infos = env.reset(seed=HELD_OUT)
    restart(policy, np.ones(env.num_envs, dtype=bool))
    width, rows = len(action_fields(env.scenario)), env.num_envs
    returned, time, under_way = np.zeros(rows), np.zeros(rows), np.ones(rows, dtype=bool)
    errors: list[np.ndarray] = []
    while under_way.any():
        actions = decide(policy, observations, width).astype(np.float32)
        observations, rewards, terminated, truncated, infos = env.step(actions)
        returned += np.where(under_way, rewards, 0.0)
        time = np.where(under_way, infos["time"], time)
        counts = under_way & (infos["time"] > SETTLED_AFTER)
        errors.append(np.where(counts, infos["position_error"], np.nan))
        under_way &= ~(terminated | truncated)
    outcome = infos["ended"]
    values = {
        "return": returned,
        "arrival_rate": (outcome == Outcome.ARRIVED).astype(float),
        "collision_rate": (outcome == Outcome.COLLIDED).astype(float),
        "travel_time_s": np.where(outcome == Outcome.ARRIVED, time, np.nan),
    }
    by_world = env.world_major(np.stack(errors, axis=1)).reshape(env.num_worlds, -1)
    kept = [world[np.isfinite(world)] for world in by_world]
    return {name: env.world_major(each) for name, each in values.items()}, kept


def _figures(values: dict[str, np.ndarray], errors: list[np.ndarray]) -> dict[str, Figure]:
    worlds = len(errors)
    draws = np.random.default_rng(0).integers(0, worlds, (RESAMPLES, worlds))
    figures = {name: _figure(_mean_of(each), draws) for name, each in values.items()}
    for share, name in ((50, "e50_m"), (95, "e95_m")):
        figures[name] = _figure(_percentile_of(errors, share), draws)
    return figures


def _mean_of(values: np.ndarray) -> Callable[[Any], float]:
    known = np.isfinite(values)
    sums, counts = np.where(known, values, 0.0).sum(axis=1), known.sum(axis=1)

    def mean(worlds: Any) -> float:
        total = counts[worlds].sum()
        return float(sums[worlds].sum() / total) if total else float("nan")

    return mean


def _percentile_of(errors: list[np.ndarray], share: float) -> Callable[[Any], float]:
    def percentile(worlds: Any) -> float:
        chosen = np.concatenate([errors[world] for world in worlds])
        return float(np.percentile(chosen, share)) if len(chosen) else float("nan")

    return percentile


def _figure(measure: Callable[[Any], float], draws: np.ndarray) -> Figure:
    resampled = np.array([measure(draw) for draw in draws])
    known = resampled[np.isfinite(resampled)]
    low, high = np.percentile(known, (2.5, 97.5)) if len(known) else (np.nan, np.nan)
    return Figure(measure(np.arange(draws.shape[1])), float(low), float(high))
