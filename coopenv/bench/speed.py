"""How fast environments step, measured in one process, alternating between cases, medians over repeats."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from statistics import median
from typing import Any

import numpy as np

from coopenv.api.engine import Engine
from coopenv.api.parallel_env import parallel_env
from coopenv.scenario import load_scenario


@dataclass(frozen=True)
class Case:
    """One thing to measure: `step` runs one environment step of `worlds` worlds of `vehicles` vehicles."""

    name: str
    worlds: int
    vehicles: int
    threads: int
    ticks_per_step: int
    dtype: str
    step: Callable[[], None]


@dataclass(frozen=True)
class Speed:
    """Median rates of one case."""

    case: Case
    env_steps_per_s: float
    agent_steps_per_s: float
    vehicle_ticks_per_s: float


def parallel_env_case(name: str, dtype: str = "float32") -> Case:
    """Return one world through `ParallelEnv.step` with random actions; infos, rewards and resets included."""
    env = parallel_env(name, dtype=dtype)
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    actions = [{a: rng.uniform(-1, 1, 2).astype(np.float32) for a in env.possible_agents} for _ in range(64)]
    turn = iter(range(1 << 62))

    def step() -> None:
        if not env.agents:
            env.reset()
        action = actions[next(turn) % len(actions)]
        env.step({agent: action[agent] for agent in env.agents})

    return Case(f"single {name}", 1, len(env.possible_agents), 1, env.scenario.ticks_per_decision, dtype, step)


def engine_case(
    name: str, worlds: int, dtype: str = "float32", threads: int | None = None, **overrides: object
) -> Case:
    """Return the batched core: random actions, observations, rewards, judgements; resets at the horizon."""
    scenario = load_scenario(name, overrides)
    engine = Engine(scenario, worlds, dtype, threads=threads)
    engine.reset(range(worlds))
    actions = np.random.default_rng(0).uniform(-1, 1, (worlds, len(scenario.vehicles), 2))

    def step() -> None:
        engine.step(actions)
        if engine.view("truncated")[0, 0]:
            engine.reset()

    label = f"batch {name}{', sensed' if overrides.get('topology.mode') == 'sensed' else ''}"
    return Case(label, worlds, len(scenario.vehicles), engine.world.threads, scenario.ticks_per_decision, dtype, step)


def measure(
    cases: list[Case],
    seconds: float = 1.0,
    repeats: int = 5,
    on_progress: Callable[[float], None] = lambda share: None,
) -> list[Speed]:
    """Time every case for about `seconds` in each of `repeats` rounds and return median rates."""
    counts = []
    for case in cases:
        case.step()  # compile
        start = time.perf_counter()
        runs = 0
        while time.perf_counter() - start < 0.2 * seconds or runs == 0:
            case.step()
            runs += 1
        counts.append(max(1, round(runs * seconds / (time.perf_counter() - start))))
    rates: list[list[float]] = [[] for _ in cases]
    for round_number in range(repeats):
        for i, case in enumerate(cases):
            on_progress((round_number + i / len(cases)) / repeats)
            start = time.perf_counter()
            for _ in range(counts[i]):
                case.step()
            rates[i].append(counts[i] * case.worlds / (time.perf_counter() - start))
    return [
        Speed(case, r, r * case.vehicles, r * case.vehicles * case.ticks_per_step)
        for case, r in zip(cases, (median(values) for values in rates), strict=True)
    ]


def own_cases(name: str = "busy_intersection") -> list[Case]:
    """Return the cases that coopenv's own figures are stated for."""
    sensed: dict[str, Any] = {"topology.mode": "sensed"}
    return [
        parallel_env_case(name),
        engine_case(name, 1024, threads=1),
        engine_case(name, 1024, threads=1, **sensed),
        engine_case(name, 1024, "float64", threads=1),
        engine_case(name, 1024, **sensed),
        parallel_env_case("urban_crossing"),
        engine_case("urban_crossing", 1024),
    ]
