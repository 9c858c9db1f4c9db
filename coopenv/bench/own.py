"""Build coopenv's own cases; runs in a worker process."""

from __future__ import annotations

import json
from collections.abc import Callable
from itertools import cycle
from typing import Any

import numpy as np

from coopenv.api.engine import Engine
from coopenv.api.parallel_env import parallel_env
from coopenv.api.vector_env import CooperativeVectorEnv, make_vec
from coopenv.bench.cases import SINGLE, Case
from coopenv.bench.growth import growth_scenario
from coopenv.bench.worker import Built

ACTIONS_DRAWN = 8
"""Batches of actions drawn beforehand, taken in turn."""


_environments: dict[str, tuple[Any, InfoSwitch]] = {}
"""The environments of the cases built so far, by all that they are made of."""


class InfoSwitch:
    """Stands for an environment's maker of infos and can leave them out."""

    def __init__(self, env: Any) -> None:
        self._write: Callable[..., dict[str, Any]] = env._infos
        self.on = True
        env._infos = self

    def __call__(self, *arguments: Any) -> dict[str, Any]:
        """Return infos, or none."""
        return self._write(*arguments) if self.on else {}


def build(case: Case) -> Built:
    """Return a case ready to step; a case without infos shares the environment of its twin, if that was built."""
    key = json.dumps([case.name, case.worlds, case.threads, case.dtype, case.options])
    if case.infos or key not in _environments:
        env = _parallel_env(case) if case.name.startswith(SINGLE) else _vector_env(case)
        env.reset(seed=0)
        _environments[key] = env, InfoSwitch(env)
    env, switch = _environments[key]
    step = _single_step(env) if case.name.startswith(SINGLE) else _batch_step(env)

    def step_with_or_without() -> int:
        switch.on = case.infos
        return step()

    return Built(step_with_or_without, array_bytes(env.engine))


def _parallel_env(case: Case) -> Any:
    return parallel_env(case.options["environment"], dtype=case.dtype, overrides=case.options["overrides"])


def _vector_env(case: Case) -> Any:
    options = case.options
    shape: dict[str, Any] = {"num_worlds": case.worlds, "dtype": case.dtype, "threads": case.threads}
    if "growth" in options:
        return CooperativeVectorEnv(growth_scenario(**options["growth"]), "growth", **shape)
    return make_vec(options["environment"], overrides=options["overrides"], **shape)


def _batch_step(env: CooperativeVectorEnv) -> Callable[[], int]:
    rng = np.random.default_rng(0)
    actions = cycle([rng.uniform(-1, 1, (env.num_envs, 2)).astype(np.float32) for _ in range(ACTIONS_DRAWN)])
    ticks = env.num_envs * env.scenario.ticks_per_decision

    def step() -> int:
        env.step(next(actions))
        return ticks

    return step


def _single_step(env: Any) -> Callable[[], int]:
    rng = np.random.default_rng(0)
    drawn = [{a: rng.uniform(-1, 1, 2).astype(np.float32) for a in env.possible_agents} for _ in range(64)]
    actions = cycle(drawn)
    ticks = env.scenario.ticks_per_decision

    def step() -> int:
        if not env.agents:
            env.reset()
        action, agents = next(actions), env.agents
        env.step({agent: action[agent] for agent in agents})
        return ticks * len(agents)

    return step


def array_bytes(engine: Engine) -> int:
    """Return the size of every array that has the world as leading axis."""
    world = engine.world
    records = [engine.report, world.state, *([] if world.memory is None else [world.memory])]
    arrays = [getattr(record, name) for record in records for name in record._cls.vars]
    return sum(a.capacity for a in [*arrays, world.actions, world.mask])
