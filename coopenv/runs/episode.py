"""Go through an episode camera tick by camera tick, and keep what an engine shows at each."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from coopenv.api.engine import Engine
from coopenv.base.seeds import world_keys
from coopenv.policies import Policy, decide, restart


def play(
    engine: Engine,
    seeds: Sequence[int],
    ticks: int,
    policy: Policy | None = None,
    to_the_end: bool = True,
    options: Mapping[str, Any] | None = None,
) -> Iterator[int]:
    """Start an episode in every world and yield the number of each camera tick, from 0, once the worlds are there.

    Args:
        engine: what is run, on any backend; it is stopped when something fails meanwhile.
        seeds: one per world.
        ticks: after the start; fewer where the backend has no more.
        policy: drives the first world; None: action zero.
        to_the_end: go on when all vehicles of the first world that are estimated here have ended.
        options: for a backend that takes some at a reset.

    Raises:
        CoopenvError: the policy returns actions of another shape.
    """
    with engine.stopping():
        engine.reset([world_keys(seed)[0] for seed in seeds], options=options)
        engine.set_actions(np.zeros_like(engine.view("actions")))
        width, here = engine.view("actions").shape[-1], [*estimated_here(engine)]
        if policy is not None:
            restart(policy, np.ones(engine.world.model.vehicles, dtype=bool))
        yield 0
        for tick in range(ticks):
            if tick % engine.world.model.ticks_per_decision == 0:
                if not to_the_end and engine.view("ended")[0, here].all():
                    return
                if policy is not None:
                    engine.set_actions(decide(policy, engine.view("observation")[0].copy(), width)[None])
            engine.step(ticks=1)
            if engine.view("exhausted")[0]:
                return
            yield tick + 1


def estimated_here(engine: Engine) -> tuple[int, ...]:
    """Return which vehicles are estimated here, not elsewhere and heard by radio."""
    here = engine.backend.capabilities.estimated
    return tuple(range(engine.world.model.vehicles)) if here is None else here


class Views:
    """Fields of an engine at several ticks; one whose copying was interrupted does not count."""

    def __init__(self, engine: Engine, names: Iterable[str]) -> None:
        self._engine = engine
        self._rows: dict[str, list[np.ndarray]] = {name: [] for name in names}
        self.taken = 0

    def take(self) -> None:
        """Copy the fields as they are now."""
        for name, rows in self._rows.items():
            rows.append(self._engine.view(name).copy())
        self.taken += 1

    def __getitem__(self, name: str) -> np.ndarray:
        """Return (K, W, ...) of one field."""
        return np.stack(self._rows[name][: self.taken])
