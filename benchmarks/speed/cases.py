"""Subjects of the measurement: libraries, and cases as plain data for a worker process."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import cycle
from typing import Any


@dataclass(frozen=True)
class Library:
    """Something that is measured in a process of its own."""

    name: str
    module: str
    """Module that a user imports."""
    build: str
    """module:function that makes a `Built` of a `Case`."""
    distributions: tuple[str, ...]
    """Whose versions matter."""


COOPENV = Library(
    "coopenv", "coopenv.api.vector_env", "benchmarks.speed.coopenv_cases:build", ("coopenv", "warp-lang", "numpy")
)


@dataclass(frozen=True)
class Case:
    """One thing to measure."""

    name: str
    library: str
    worlds: int
    vehicles: int
    """Agents that are given an action."""
    threads: int = 1
    dtype: str = "float32"
    tick: str = "camera ticks"
    """Name of the counted vehicle ticks."""
    options: dict[str, Any] = field(default_factory=dict)
    """Whatever the library's builder wants to know."""


@dataclass(frozen=True)
class Built:
    """A case ready to be measured."""

    step: Callable[[], int]
    """Advances all worlds by one environment step, restarts what is over, returns the vehicle ticks that it did."""
    array_bytes: int | None = None
    """Size of all worlds' arrays, if known."""


ACTIONS_DRAWN = 64
"""Actions of single worlds that are drawn beforehand, taken in turn."""


def parallel_step(env: Any, draw: Callable[[], Any], ticks: int) -> Callable[[], int]:
    """Return a step of a PettingZoo `ParallelEnv`, which counts `ticks` per agent; `draw` makes an agent's action."""
    actions = cycle([{agent: draw() for agent in env.possible_agents} for _ in range(ACTIONS_DRAWN)])

    def step() -> int:
        if not env.agents:
            env.reset()
        action, agents = next(actions), env.agents
        env.step({agent: action[agent] for agent in agents})
        return ticks * len(agents)

    return step
