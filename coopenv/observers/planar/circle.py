"""Whom of the others a planar robot believes."""

import math

from coopenv.observers.contract import Tick
from coopenv.observers.planar.bearing import misfit
from coopenv.observers.planar.heard import Sightings, place_of
from coopenv.observers.planar.trust import Trust

SWAYED_S = 60.0  # for so long, who has believed a liar may be off


class Circle:
    """What one robot thinks of the words of all others, by what they tell and what is seen of them."""

    def __init__(self, bearing_std: float) -> None:
        self._bearing_std = bearing_std
        self._trust: dict[int, Trust] = {}
        self._used: dict[int, float] = {}  # when the word of each counted last, s

    def of(self, target: int) -> Trust:
        """Return what is thought of one."""
        return self._trust.setdefault(target, Trust())

    def hear(self, tick: Tick) -> None:
        """Test what others tell of their places against what they told before."""
        for target, received in tick.messages.items():
            if (place := place_of(received)) is not None:
                self.of(target).hear(tick.time - received.age, place)

    def believes(self, target: int, time: float) -> bool:
        """Return whether a robot is believed, whose word counts now if it is."""
        believed = self.of(target).believed
        if believed:
            self._used[target] = time
        return believed

    def witness(self, tick: Tick, by: int, told: Sightings) -> None:
        """Compare what a robot that is sure of its place saw of others with their word."""
        witness = self.of(by)
        witness.claim(tick.time, told.sure)
        if not (told.sure and witness.believed):
            return
        for target, bearing in told.seen:
            place = place_of(tick.messages[target]) if target in tick.messages else None
            if place is not None:
                trust = self.of(target)
                trust.witness(by, *misfit(bearing, told.by, place, self._bearing_std))
                if trust.believed and trust.accused(tick.time, self._trust):
                    trust.doubt()

    def misled(self, time: float) -> bool:
        """Return whether somebody is not believed any more whose word has counted lately; everyone is told of once."""
        liars = [target for target in self._used if not self._trust[target].believed]
        return any(time - self._used.pop(target, -math.inf) < SWAYED_S for target in liars)
