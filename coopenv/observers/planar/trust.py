"""Whether another robot's word is to be believed: told places against each other, and against sightings.

A place that jumps by more than a robot can drive and both words allow is a lie, or a mistake. One that drifts away is
found out by a sum (Page, "Continuous inspection schemes", Biometrika 41, 1954) of the normalised innovations squared of
sightings of that robot and by it, each less what an honest one has; it counts where one's own place is known by
landmarks, as else it may be oneself that is wrong. Robots that see no landmark judge by others that do, and tell whom
they saw and from where: who is contradicted by one of them, or, where it sees landmarks itself, by two of whom
each is contradicted by fewer, is not believed. Who has lied is believed again after as many sightings that fit.
"""

import math
from collections.abc import Mapping

from coopenv.observers.planar.state import PlanarPose

FASTEST = 0.6  # m/s, that a robot may drive
WIDE = 5.0  # standard deviations that a place may change by
SILENCE_S = 1.0  # after which a place may be any: who was lost says nothing, and comes back elsewhere
HONEST = 2.5  # mean of the innovation squared up to which a robot is honest; 1 where covariances are
MOST = 40.0  # of the sum
LARGEST = 16.0  # that one sighting adds
FITS = 4.0  # innovation squared of a sighting that fits
CLEAR = 0.2  # rad; sightings that are less certain say nothing about a lie
ENOUGH = 20  # sightings in a row that fit, after which a robot is believed again
WITNESSES = 2  # that it takes against a robot which says that it is sure of its place
CLAIM_S = 15.0  # for which that counts
CONTRADICTS = 10.0  # of the sum of one witness


class Trust:
    """What one robot thinks of the word of another."""

    def __init__(self) -> None:
        self.believed = True
        self._sum, self._fitting = 0.0, 0
        self._told: dict[int, float] = {}  # the sums of witnesses
        self._sure = -math.inf
        self._time = -math.inf
        self._last: PlanarPose | None = None

    def hear(self, time: float, place: PlanarPose) -> None:
        """Take a place that was told at a time in s."""
        if time <= self._time:
            return
        if self._last is not None and time - self._time < SILENCE_S:
            moved = math.dist(place.pose[:2].tolist(), self._last.pose[:2].tolist())
            spread = sum(float(word.covariance[0, 0] + word.covariance[1, 1]) for word in (place, self._last))
            if moved > FASTEST * (time - self._time) + WIDE * math.sqrt(spread):
                self.doubt()
        self._time, self._last = time, place

    def see(self, ratio: float, variance: float, sure: bool) -> None:
        """Take the innovation squared of a sighting, its variance in rad^2, and whether one's own place is sure."""
        if not self.believed:
            self._fitted(ratio < FITS and variance < CLEAR**2 and sure)
        elif sure:
            self._sum = max(self._sum + min(ratio, LARGEST) - HONEST, 0.0)
            if self._sum > MOST:
                self.doubt()

    def witness(self, by: int, ratio: float, variance: float) -> None:
        """Take how far off it was to a robot whose place is sure, squared and normalised, and the variance, rad^2."""
        told = self._told.get(by, 0.0)
        self._told[by] = min(max(told + min(ratio, LARGEST) - HONEST, 0.0), MOST)
        if not self.believed:
            self._fitted(ratio < FITS and variance < CLEAR**2)

    def accusers(self) -> list[int]:
        """Return who contradicts this one."""
        return [by for by, told in self._told.items() if told > CONTRADICTS]

    def claim(self, time: float, sure: bool) -> None:
        """Take whether it says, at a time in s, that landmarks show where it is."""
        self._sure = time if sure else self._sure

    def accused(self, time: float, everyone: Mapping[int, "Trust"]) -> bool:
        """Return whether others show that this one lies, and not they."""
        by = self.accusers()
        if not by or sum(self._told.values()) < MOST:
            return False
        if time - self._sure > CLAIM_S:
            return True
        return len(by) >= WITNESSES and all(len(everyone[j].accusers()) < len(by) for j in by)

    def doubt(self) -> None:
        """Believe this one no more."""
        self.believed, self._fitting = False, 0

    def _fitted(self, fits: bool) -> None:
        self._fitting = self._fitting + 1 if fits else 0
        if self._fitting >= ENOUGH:
            self.believed, self._sum = True, 0.0
            self._told.clear()
