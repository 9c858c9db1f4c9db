"""coopenv's own cases: which they are, and how a worker process builds them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import cycle
from typing import Any

import numpy as np
import warp as wp

from benchmarks.speed.cases import COOPENV, Built, Case, parallel_step
from benchmarks.speed.growth import growth_scenario
from coopenv.api.engine import Engine
from coopenv.api.make import make_vec, parallel_env
from coopenv.api.vector_env import CooperativeVectorEnv
from coopenv.scenario import Scenario
from coopenv.world.launch import default_threads
from coopenv.world.warp_internals import field_types

SINGLE, BATCH = "ParallelEnv", "make_vec"
BATCHES = (1, 32, 1024, 8192)
QUICK_BATCHES = (1, 32, 1024)
ROBUST = "robust"
ROBUST_BATCH = 1024
BIG = 1024
"""Vehicles of one world on a grid, see `growth_scenario`."""
BATCHES_DRAWN = 8
"""Batches of actions that are drawn beforehand, taken in turn."""


def all_threads() -> int:
    """Return the threads that a large batch is split over when nobody says otherwise."""
    return default_threads()


def own_cases(
    environment: str, scenario: Scenario, overrides: Mapping[str, Any] | None = None, quick: bool = False
) -> list[Case]:
    """Return coopenv's cases: one world, batches, precisions, threads, the observer `robust`.

    Visibility is sensed, unless `overrides` set `topology.mode`; where the file says otherwise, two cases follow that
    are as the file says.
    """
    given = dict(overrides or {})
    sensed = {"topology.mode": "sensed", **given}

    def case(name: str, worlds: int, threads: int, dtype: str, changes: dict[str, Any]) -> Case:
        options = {"environment": environment, "overrides": changes}
        return Case(name, COOPENV.name, worlds, len(scenario.vehicles), threads, dtype, options=options)

    dtypes = ("float32",) if quick else ("float32", "float64")
    cases = [case(SINGLE, 1, 1, dtype, sensed) for dtype in dtypes]
    for worlds in QUICK_BATCHES if quick else BATCHES:
        for threads in sorted({1, min(worlds, all_threads())}):
            cases += [case(BATCH, worlds, threads, dtype, sensed) for dtype in dtypes]
    if not quick and scenario.observer.name != ROBUST and "observer.name" not in given:
        robust = {**sensed, "observer.name": ROBUST}
        for threads in sorted({1, all_threads()}):
            cases.append(case(f"{BATCH}, {ROBUST}", ROBUST_BATCH, threads, "float32", robust))
        shape = {"vehicles": BIG, "landmarks": BIG, "sensed": True, "nearby": True}
        for observer in ("riccati", ROBUST):
            options = {"growth": {**shape, "observer": observer}}
            name = f"{BIG:,} vehicles, {observer}"
            cases += [
                Case(name, COOPENV.name, 1, BIG, threads, "float32", options=options)
                for threads in sorted({1, all_threads()})
            ]
    if scenario.topology.mode != "sensed" and "topology.mode" not in given:
        mode = scenario.topology.mode
        cases.append(case(f"{SINGLE}, {mode}", 1, 1, "float32", given))
        cases.append(case(f"{BATCH}, {mode}", 1024, all_threads(), "float32", given))
    return cases


def build(case: Case) -> Built:
    """Return a case of coopenv ready to step; runs in a worker process."""
    if case.name.startswith(SINGLE):
        env = parallel_env(case.options["environment"], dtype=case.dtype, overrides=case.options["overrides"])
        env.reset(seed=0)
        rng = np.random.default_rng(0)
        step = parallel_step(env, lambda: rng.uniform(-1, 1, 2).astype(np.float32), env.scenario.ticks_per_decision)
        return Built(step, array_bytes(env.engine))
    batch = _vector_env(case)
    batch.reset(seed=0)
    return Built(_batch_step(batch), array_bytes(batch.engine))


def _vector_env(case: Case) -> CooperativeVectorEnv:
    options = case.options
    shape: dict[str, Any] = {"num_worlds": case.worlds, "dtype": case.dtype, "threads": case.threads}
    if "growth" in options:
        return CooperativeVectorEnv(growth_scenario(**options["growth"]), "growth", **shape)
    return make_vec(options["environment"], overrides=options["overrides"], **shape)


def _batch_step(env: CooperativeVectorEnv) -> Callable[[], int]:
    rng = np.random.default_rng(0)
    actions = cycle([rng.uniform(-1, 1, (env.num_envs, 2)).astype(np.float32) for _ in range(BATCHES_DRAWN)])
    ticks = env.num_envs * env.scenario.ticks_per_decision

    def step() -> int:
        env.step(next(actions))
        return ticks

    return step


def array_bytes(engine: Engine) -> int:
    """Return the size of every array that has the world as leading axis."""
    world = engine.world
    records = [engine.results, world.state, world.memory]
    fields = [getattr(record, name) for record in records for name in field_types(record)]
    arrays = [field for field in fields if isinstance(field, wp.array)]
    stored = [getattr(a, "row", a) for a in [*arrays, world.actions, world.mask]]  # what all indices share counts once
    return sum(a.size * wp.types.type_size_in_bytes(a.dtype) for a in stored)
