"""Fusion of received robot poses: checks of messages and suspected senders."""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from coopenv.estimation.poses import Array
from coopenv.observers.contract import Received, Tick
from coopenv.observers.planar.model import PlanarPose, misfit

OLDEST_S = 2.0
SPEED = 0.15  # m/s, by which a robot may have moved since it told where it is
LEAST_STD = (0.01, 0.002)  # m, rad; nobody knows better
FARTHEST_M = 1e6
MOST_SEEN = 64  # robots, of which one message may tell
POSE_NUMBERS = 9  # x, y, heading and the triangle of their covariance
LOWER = np.tril_indices(3)


def place_of(received: Received) -> PlanarPose | None:
    """Return where a robot is by its own word; None where that is no place or older than 2 s.

    Of a neighbour's heading nothing is needed, so it is 0 and certain.
    """
    position, told = received.message.position, received.message.covariance
    if position is None or told is None or not 0.0 <= received.age <= OLDEST_S:
        return None
    p, P = np.asarray(position, dtype=float), np.asarray(told, dtype=float)
    if p.shape != (3,) or P.ndim != 2 or min(P.shape) < 2 or not _plausible(p[:2], P[:2, :2]):
        return None
    covariance = np.zeros((3, 3))
    covariance[:2, :2] = (P[:2, :2] + P[:2, :2].T) / 2
    covariance[[0, 1], [0, 1]] += LEAST_STD[0] ** 2 + (SPEED * received.age) ** 2
    return PlanarPose(np.array([p[0], p[1], 0.0]), covariance)


class Sightings(NamedTuple):
    """What a robot tells of whom it saw."""

    by: PlanarPose  # where it was
    seen: list[tuple[int, float]]  # targets and bearings, rad
    sure: bool  # whether landmarks showed it lately that it is not lost


def sightings_of(extra: Mapping[str, Array]) -> Sightings | None:
    """Return what a robot tells of whom it saw; None where that makes no sense."""
    seen, bearing, told, sure = (np.asarray(extra.get(name, ())) for name in ("seen", "bearing", "from", "sure"))
    if any(numbers.dtype.kind not in "buif" for numbers in (seen, bearing, told, sure)):
        return None
    if told.shape != (POSE_NUMBERS,) or seen.ndim != 1 or bearing.shape != seen.shape or len(seen) > MOST_SEEN:
        return None
    pose, covariance = told[:3].astype(float), np.zeros((3, 3))
    covariance[LOWER] = told[3:]
    covariance += np.tril(covariance, -1).T
    if not _plausible(pose, covariance) or not np.isfinite(bearing.astype(float)).all():
        return None
    by = PlanarPose(pose, covariance + np.diag(np.square([LEAST_STD[0], *LEAST_STD])))
    angles = zip(seen.tolist(), bearing.astype(float).tolist(), strict=True)
    return Sightings(by, list(angles), sure.shape == (1,) and bool(sure[0]))


def _plausible(where: Array, covariance: Array) -> bool:
    """Return whether numbers are finite, a place is on this site and a covariance is one."""
    if not (np.isfinite(where).all() and np.isfinite(covariance).all()) or np.abs(where).max() > FARTHEST_M:
        return False
    scale = float(np.abs(covariance).max())
    if scale > FARTHEST_M**2 or not np.allclose(covariance, covariance.T, atol=1e-3 * scale):
        return False
    return bool(np.linalg.eigvalsh(covariance)[0] >= -1e-3 * scale)


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
