"""What every source of ticks offers; the interfaces of an environment know no more of it."""

from __future__ import annotations

from typing import Protocol

from coopenv.observers.recording import Briefing, Sensed
from coopenv.scenario import Scenario
from coopenv.world.world import World


class Senses(Protocol):
    """Where the ticks of plug-in observers are read from."""

    @property
    def briefing(self) -> Briefing:
        """What the observers are told before the first tick."""
        ...

    def read(self, world: int, k: int) -> Sensed:
        """Return what the vehicles of one world sense at the present tick k."""
        ...


class Backend(Protocol):
    """Where measurements come from: computed, or replayed."""

    scenario: Scenario
    """Who is there, how they sense, talk and estimate."""

    def world(self, worlds: int, dtype: str, device: str, threads: int | None) -> World:
        """Return the world whose state the ticks fill; arguments as for `World`."""
        ...

    def senses(self, world: World) -> Senses:
        """Return the reader of that world's ticks for observers on the host."""
        ...
