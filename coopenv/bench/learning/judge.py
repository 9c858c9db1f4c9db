"""How the agents of a study and the drivers beside them do on held-out worlds; everybody drives once."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from coopenv.api.engine import Engine
from coopenv.backends.sources import open_simulation
from coopenv.bench.agents.contest import IDEAL_SENSING
from coopenv.evaluation import Difference, Episodes, Result, compare_paired, drive, held_out_seeds, score
from coopenv.policies import load_agent

REPORTED, CHOSEN = 0, 1
"""Blocks of held-out seeds: figures on cards are of the first; which seed is the best is decided in the second."""

Key = tuple[str, ...]
"""Environment, agent, overrides, and when its weights were written."""


class Judge:
    """Drives agents in the same worlds, and remembers what came of it: figures, and one environment's episodes."""

    def __init__(self, worlds: int) -> None:
        """Take so many worlds of either block."""
        self.worlds = worlds
        self._environment = ""
        self._episodes: dict[Key, Episodes] = {}
        self._results: dict[Key, list[Result]] = {}
        self._differences: dict[tuple[Key, Key], list[Difference]] = {}
        self._merits: dict[Key, float] = {}

    def results(self, environment: str, agent: str | Path, overrides: Mapping[str, Any] | None = None) -> list[Result]:
        """Return the figures of an agent in the reported worlds, under overrides of the environment."""
        key = _key(environment, agent, overrides or {})
        if key not in self._results:
            self._results[key] = score(self._reported(environment, agent, overrides or {}))
        return self._results[key]

    def ideal(self, environment: str, agent: str) -> list[Result]:
        """Return those of an agent that sees everything."""
        return self.results(environment, agent, IDEAL_SENSING)

    def against(self, environment: str, agent: str | Path, other: str | Path) -> list[Difference]:
        """Return how much an agent's figures differ from another's in the same worlds."""
        pair = _key(environment, agent, {}), _key(environment, other, {})
        if pair not in self._differences:
            own, others = (self._reported(environment, each, {}) for each in (agent, other))
            self._differences[pair] = compare_paired(own, others)
        return self._differences[pair]

    def merit(self, environment: str, agent: Path, overrides: Mapping[str, Any]) -> float:
        """Return the mean return of an agent by the reward that it learnt from, in worlds of the other block."""
        key = _key(environment, agent, overrides)
        if key not in self._merits:
            results = score(self._drive(environment, agent, overrides, CHOSEN))
            self._merits[key] = {result.metric: result.mean for result in results}["return"]
        return self._merits[key]

    def _reported(self, environment: str, agent: str | Path, overrides: Mapping[str, Any]) -> Episodes:
        if environment != self._environment:  # episodes are large, and those of one environment are wanted together
            self._environment = environment
            self._episodes.clear()
        key = _key(environment, agent, overrides)
        if key not in self._episodes:
            self._episodes[key] = self._drive(environment, agent, overrides, REPORTED)
        return self._episodes[key]

    def _drive(self, environment: str, agent: str | Path, overrides: Mapping[str, Any], block: int) -> Episodes:
        scenario = open_simulation(environment, overrides)
        engine = Engine(scenario, self.worlds)
        try:
            return drive(engine, load_agent(agent, scenario), held_out_seeds(block, self.worlds))
        finally:
            engine.close()


def _key(environment: str, agent: str | Path, overrides: Mapping[str, Any]) -> Key:
    """Return what episodes depend on: weights that are trained anew are another agent."""
    weights = sorted(str(path.stat().st_mtime_ns) for path in Path(agent).glob("*.safetensors"))
    return (environment, str(agent), repr(sorted(overrides.items())), *weights)
