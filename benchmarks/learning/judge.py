"""The judge of trained agents: figures in held-out worlds, each measured once."""

import json
from collections.abc import Mapping
from contextlib import closing
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from coopenv.api.engine import Engine
from coopenv.evaluation import Difference, Episodes, Result, compare_paired, drive, held_out_seeds, score
from coopenv.policies import load_agent
from coopenv.sources.sources import open_simulation

REPORTED, CHOSEN = 0, 1
"""Blocks of held-out seeds: figures on cards are of the first; which seed is the best is decided in the second."""


class Driven(NamedTuple):
    """Inputs that determine the episodes."""

    environment: str
    agent: str
    overrides: str
    """Overrides as JSON."""
    block: int
    weights: tuple[int, ...]
    """Modification times of the weights: retrained weights are another agent."""


class Judge:
    """Drives agents in the same worlds, and stores the results: figures, and one environment's episodes."""

    def __init__(self, worlds: int) -> None:
        """Take so many worlds of either block."""
        self.worlds = worlds
        self._episodes: dict[Driven, Episodes] = {}
        self._score = cache(lambda driven: score(self._drive(driven)))
        self._compare = cache(lambda own, other: compare_paired(self._drive(own), self._drive(other)))

    def results(
        self, environment: str, agent: str | Path, overrides: Mapping[str, Any] | None = None, block: int = REPORTED
    ) -> list[Result]:
        """Return the figures of an agent in the worlds of a block, under overrides of the environment."""
        return self._score(_driven(environment, agent, overrides or {}, block))

    def against(self, environment: str, agent: str | Path, other: str | Path) -> list[Difference]:
        """Return the differences between two agents' figures in the same worlds."""
        return self._compare(*(_driven(environment, each, {}, REPORTED) for each in (agent, other)))

    def merit(self, environment: str, agent: Path, overrides: Mapping[str, Any]) -> float:
        """Return the mean return of an agent by the reward that it learnt from, in worlds of the other block."""
        results = self.results(environment, agent, overrides, CHOSEN)
        return {result.metric: result.mean for result in results}["return"]

    def _drive(self, driven: Driven) -> Episodes:
        """Return episodes; large ones stay only as long as others of their environment are wanted for comparison."""
        if any(other.environment != driven.environment for other in self._episodes):
            self._episodes.clear()
        if driven in self._episodes:
            return self._episodes[driven]
        scenario = open_simulation(driven.environment, json.loads(driven.overrides))
        with closing(Engine(scenario, self.worlds)) as engine:
            found = drive(engine, load_agent(driven.agent, scenario), held_out_seeds(driven.block, self.worlds))
        if driven.block == REPORTED:
            self._episodes[driven] = found
        return found


def _driven(environment: str, agent: str | Path, overrides: Mapping[str, Any], block: int) -> Driven:
    weights = sorted(path.stat().st_mtime_ns for path in Path(agent).glob("*.safetensors"))
    return Driven(environment, str(agent), json.dumps(overrides, sort_keys=True), block, tuple(weights))
