"""Time cases, alternating between them, and take medians over rounds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from statistics import median
from typing import Any

from benchmarks.speed.cases import Case
from benchmarks.speed.workers import WorkerError, Workers

OnProgress = Callable[[str], None]
"""Told, before each unit of work, what it is."""


@dataclass
class Result:
    """Results of a case."""

    case: Case
    built: dict[str, Any] = field(default_factory=dict)
    """Result of `Workers.build`."""
    rounds: list[dict[str, Any]] = field(default_factory=list)
    """Results of `Workers.run`."""
    problem: str = ""
    """Why there are no figures."""

    def _per_second(self, amount: Callable[[dict[str, Any]], float]) -> float:
        result: float = median(amount(r) / r["wall_s"] for r in self.rounds)
        return result

    @property
    def env_steps_per_s(self) -> float:
        """Steps of one world, summed over worlds."""
        return self._per_second(lambda r: r["steps"]) * self.case.worlds

    @property
    def agent_steps_per_s(self) -> float:
        """Steps of one agent, summed over agents."""
        return self.env_steps_per_s * self.case.vehicles

    @property
    def vehicle_ticks_per_s(self) -> float:
        """Whatever `case.tick` counts."""
        return self._per_second(lambda r: r["ticks"])

    @property
    def cpu_seconds_per_step(self) -> float:
        """CPU time of one step of the whole batch, s; other programs change it little."""
        result: float = median(r["cpu_s"] / r["steps"] for r in self.rounds)
        return result

    @property
    def spread(self) -> tuple[float, float]:
        """Lowest and highest rate of a round, relative to the median."""
        rates = [r["steps"] / r["wall_s"] for r in self.rounds]
        return min(rates) / median(rates), max(rates) / median(rates)

    @property
    def cores_used(self) -> float:
        """CPU time over wall time; below `case.threads` when other programs take the cores."""
        return self._per_second(lambda r: r["cpu_s"])

    def row(self) -> dict[str, Any]:
        """Return the figures as plain data."""
        case, (low, high) = self.case, self.spread
        grown, arrays = self.built["rss_bytes"], self.built["array_bytes"]
        return {
            "name": case.name,
            "library": case.library,
            "worlds": case.worlds,
            "vehicles": case.vehicles,
            "threads": case.threads,
            "dtype": case.dtype,
            "env_steps_per_s": self.env_steps_per_s,
            "agent_steps_per_s": self.agent_steps_per_s,
            "vehicle_ticks_per_s": self.vehicle_ticks_per_s,
            "counted_as_vehicle_ticks": case.tick,
            "slowest_round": low,
            "fastest_round": high,
            "cores_used": self.cores_used,
            "build_s": self.built["build_s"],
            "first_step_s": self.built["first_step_s"],
            "array_bytes_per_world": None if arrays is None else arrays / case.worlds,
            "rss_bytes_per_world": None if grown is None else grown / case.worlds,
            "options": case.options,
        }


def measure(
    cases: list[Case],
    workers: Workers,
    seconds: float,
    repeats: int,
    on_progress: OnProgress = lambda text: None,
) -> list[Result]:
    """Build every case, then step each for `seconds` in each of `repeats` rounds.

    A case that cannot be built or stepped has a `problem`, and the others go on.
    """
    results = [Result(case) for case in cases]
    for result in results:
        on_progress(f"building {describe(result.case)}")
        try:
            result.built = workers.build(result.case)
        except WorkerError as error:
            result.problem = f"failed: {error}"
    for _ in range(repeats):
        for result in results:
            on_progress(describe(result.case))
            if result.problem:
                continue
            try:
                result.rounds.append(workers.run(result.case, result.built["id"], seconds))
            except WorkerError as error:
                result.problem = f"failed: {error}"
    return results


def units_of_work(cases: list[Case], repeats: int) -> int:
    """Return how often `measure` reports progress."""
    return len(cases) * (repeats + 1)


def describe(case: Case) -> str:
    """Return a short name for a person who waits."""
    return f"{case.name} x {case.worlds}" if case.worlds > 1 else case.name
