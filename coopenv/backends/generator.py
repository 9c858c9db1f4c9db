"""Backends whose episodes are Python generators: simulated, recorded, or a test's."""

from abc import ABC, abstractmethod
from collections.abc import Generator, Iterator, Mapping
from typing import Any

from coopenv.backends.base import Capabilities, Command, Health
from coopenv.errors import CoopenvError
from coopenv.observers.recording import Sensed
from coopenv.scenario import Scenario

Episode = Generator[Sensed, Command, None]
"""Yields tick 0, and then one tick for every command that it is sent; it ends by returning, or by being closed."""


class TickGenerator(ABC):
    """A backend that is told how an episode goes, in simulated time; see `Backend` for its methods."""

    def __init__(self, scenario: Scenario, capabilities: Capabilities) -> None:
        self.scenario = scenario
        self.capabilities = capabilities
        self.health = Health()
        self.clock = 0.0
        self._episode: Episode | None = None

    @abstractmethod
    def episode(self, seed: int | None, options: Mapping[str, Any]) -> Episode:
        """Return a new episode; arguments as for `Backend.reset`."""

    def reset(self, seed: int | None, options: Mapping[str, Any]) -> Sensed:
        """Begin an episode and return tick 0. Raises CoopenvError: there is no tick."""
        self.stop("reset")
        self._episode = self.episode(seed, options)
        first = next(self._episode, None)
        if first is None:
            raise CoopenvError(f"{type(self).__name__}: the episode ended before its first tick")
        return self._counted(first)

    def advance(self, command: Command) -> Iterator[Sensed]:
        """Yield the ticks of one decision."""
        for _ in range(self.scenario.ticks_per_decision):
            if self._episode is None:
                return
            try:
                tick = self._episode.send(command)
            except StopIteration:
                return
            yield self._counted(tick)

    def stop(self, reason: str) -> None:
        """End the episode."""
        if self._episode is not None:
            self._episode.close()
        self._episode = None

    def close(self) -> None:
        """End the episode."""
        self.stop("closed")

    def _counted(self, tick: Sensed) -> Sensed:
        self.health.count(tick)
        self.clock = tick.index * tick.dt if tick.time is None else tick.time
        return tick
