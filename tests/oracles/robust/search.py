"""Finding one's pose from nothing: every solution of the P3P problem is followed until motion has told them apart.

Bearings have a sign (cheirality), which the perspective solver and the tests here heed. Each hypothesis is a small
filter of its own; it pays for what it predicts badly, and one that pays much more than the best is given up.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from coopenv.estimation.arrays import Array, solve
from coopenv.observers.contract import Tick
from coopenv.observers.robust.constants import (
    BEARING_GATE,
    BEND_TIME,
    CLEAR_TIME,
    CORRELATION_FACTOR,
    CORRELATION_TIME,
    DOUBT_TIME,
    KNOWN_ANGLE,
    KNOWN_POSITION,
    MAX_BEARING_COST,
    MAX_CONDITION,
    MAX_HYPOTHESES,
    MAX_MISFIT,
    MAX_PRIOR_COST,
    MIN_DOUBTFUL_TIME,
    MIN_SEARCH_TIME,
    PATIENCE,
    PERTURBATION,
    PRUNE_GAP,
    SAME_HYPOTHESIS,
    SAME_PRIOR,
    SAME_TIME,
)
from tests.helpers.p3p import solve_one
from tests.oracles.p3p import solve_p3p
from tests.oracles.robust.belief import Belief
from tests.oracles.robust.matrices import condition, invert_positive, tangent_basis
from tests.oracles.robust.sight import Sight
from tests.oracles.robust.tracklets import left_error


@dataclass(frozen=True)
class Sighting:
    """A bearing to a target whose place is known or heard."""

    bearing: Array  # (3,) body frame
    z: Array  # (3,) map frame, m
    variance: float  # of z per axis, m^2


@dataclass
class Hypothesis:
    """A pose with covariance, and what it has paid."""

    belief: Belief
    paid: float
    surprise: float
    """Squared distance from the prior, which ranks those that have paid the same."""
    misfit: float = 0.0
    """What it has paid by its own noise, less twice what a true one pays."""

    @property
    def price(self) -> tuple[float, float]:
        """What the hypotheses are ranked by."""
        return self.paid, self.surprise


class Search:
    """Hypotheses about one vehicle's pose.

    Args:
        R: (3, 3) prior orientation, carried on by odometry in the meantime.
        p: (3,) prior position, m.
        P: (6, 6) prior covariance.
    """

    def __init__(self, vehicle: int, R: Array, p: Array, P: Array) -> None:
        """Start without hypotheses."""
        self.vehicle = vehicle
        self.prior = Belief(vehicle, R, p, P)
        self.bank: list[Hypothesis] = []
        self.age, self.waited, self.clear, self.attempts = 0.0, 0.0, 0.0, 0
        self.least_age = MIN_SEARCH_TIME
        self.next_look = 0.0  # not before so much has been waited

    @property
    def best(self) -> Belief:
        """The hypothesis that has paid least, the prior if there is none."""
        return min(self.bank, key=lambda h: h.price).belief if self.bank else self.prior

    def move(self, tick: Tick, noise: Array) -> None:
        """Carry everything through a tick's odometry."""
        for belief in (self.prior, *(h.belief for h in self.bank)):
            belief.move(0, tick.rotation, tick.translation, noise)

    def look(self, tick: Tick, sightings: list[Sighting], variance: float) -> Belief | None:
        """Take a frame's sightings; return the only hypothesis that is left after some frames."""
        if not self.bank:
            if len(sightings) >= 3:
                self._begin(tick, sightings, variance)
            return None
        self.age += tick.dt
        _follow(self.bank, tick, sightings, variance, max(CORRELATION_FACTOR, CORRELATION_TIME / tick.dt))
        self._prune()
        return self.bank[0].belief if len(self.bank) == 1 and self.age >= self.least_age else None

    def _begin(self, tick: Tick, sightings: list[Sighting], variance: float) -> None:
        """Follow a known prior at first; then a frame's solutions, too, if for a while all were well determined.

        Every attempt takes other sightings. Where two solutions nearly meet, where they may be is no ellipsoid, and
        noise makes them come and go. A follower's leaders improve meanwhile, which sets them apart.
        """
        if self.attempts == 0 and is_known(self.prior.P):
            self.bank, self.age, self.attempts = [self._prior()], 0.0, 1
            _follow(self.bank, tick, sightings, variance, CORRELATION_FACTOR)
            return
        triples = sorted(combinations(range(len(sightings)), 3), key=lambda c: -_spread(sightings, c))
        three = triples[self.attempts % len(triples)]
        self.waited += tick.dt
        if self.waited < min(PATIENCE, self.next_look - SAME_TIME):
            return
        poses = self._poses(tick, [sightings[n] for n in three], variance)
        if poses is None:
            self.clear, self.next_look = 0.0, self.waited + DOUBT_TIME
            return
        self.clear += tick.dt
        if self.clear < CLEAR_TIME and self.waited < PATIENCE:
            return
        solutions = self._different(poses)
        bank = [*solutions, self._prior()] if is_known(self.prior.P) else solutions
        _follow(bank, tick, sightings, variance, CORRELATION_FACTOR, dict.fromkeys(range(len(solutions)), three))
        self.bank = sorted(bank, key=lambda h: h.price)[:MAX_HYPOTHESES]
        self.age, self.clear, self.attempts = 0.0, 0.0, self.attempts + 1
        self.least_age = MIN_SEARCH_TIME if self.waited < PATIENCE else MIN_DOUBTFUL_TIME

    def _prior(self) -> Hypothesis:
        """Return the prior as a hypothesis."""
        own = self.prior.own
        return Hypothesis(Belief(self.vehicle, own.R, own.p, self.prior.P.copy()), 0.0, 0.0)

    def _poses(self, tick: Tick, three: list[Sighting], variance: float) -> list[Belief] | None:
        """Return the poses that explain three sightings; None if one of them is not well determined."""
        result = []
        for R, camera in _perspectives(three, variance):
            belief = Belief(self.vehicle, R, camera - R @ tick.lever_arm, np.zeros((6, 6)))
            P = _covariance(belief, tick, three, variance)
            if self.waited < PATIENCE and (P is None or not is_known(P)):
                return None
            if P is not None:
                belief.P = P
                result.append(belief)
        return result

    def _different(self, poses: list[Belief]) -> list[Hypothesis]:
        """Return hypotheses of the first poses that can be told apart from those before."""
        result: list[Hypothesis] = []
        for belief in poses:
            surprise = self._surprise(belief)
            hypothesis = Hypothesis(belief, min(surprise, MAX_PRIOR_COST), surprise)
            if len(result) < MAX_HYPOTHESES and not any(_same(hypothesis, other) for other in result):
                result.append(hypothesis)
        return result

    def confirms_prior(self, belief: Belief) -> bool:
        """Return whether a pose is the prior's, the prior being certain enough to go on with."""
        return is_known(self.prior.P) and self._surprise(belief) < SAME_PRIOR

    def _surprise(self, belief: Belief) -> float:
        """Return the squared distance from the prior, in standard deviations."""
        e = left_error(self.prior.own.R, self.prior.own.p, belief.own.R, belief.own.p)
        return float(e.dot(solve(self.prior.P + belief.P, e)))

    def _prune(self) -> None:
        """Give up what pays much more than the best, what is the same as a better one, and all if none is good."""
        ranked = sorted(self.bank, key=lambda h: h.price)
        kept: list[Hypothesis] = []
        for hypothesis in ranked:
            if hypothesis.paid <= ranked[0].paid + PRUNE_GAP and not any(_same(hypothesis, other) for other in kept):
                kept.append(hypothesis)
        self.bank = [] if kept[0].misfit > MAX_MISFIT else kept


def is_known(P: Array) -> bool:
    """Return whether a pose of covariance P (6, 6) is certain enough to linearise about and to tell others."""
    variances = P.diagonal().tolist()
    result: bool = max(variances[:3]) < KNOWN_ANGLE**2 and max(variances[3:]) < KNOWN_POSITION**2
    return result


def _spread(sightings: list[Sighting], three: tuple[int, ...]) -> float:
    """Return the volume that three bearings span; a good triple looks in three very different directions."""
    a, b, c = (sightings[n].bearing for n in three)
    return float(np.linalg.norm(np.cross(b - a, c - a)))


def _perspectives(three: list[Sighting], variance: float) -> Iterator[tuple[Array, Array]]:
    """Yield the poses (R, camera) that explain three sightings, then what they may have been.

    Where two solutions lie close together noise can make both of them vanish. So every bearing, and every place that is
    not exactly known, is also moved by `PERTURBATION` standard deviations to each side.
    """
    b, z = np.array([s.bearing for s in three]), np.array([s.z for s in three])
    yield from zip(*solve_one(b, z, solve_p3p), strict=True)
    bearings, places = [], []
    for n, s in enumerate(three):
        for side in (PERTURBATION, -PERTURBATION):
            for axis in tangent_basis(b[n : n + 1])[0]:
                moved = b.copy()
                moved[n] += side * math.sqrt(variance) * axis
                moved[n] /= np.linalg.norm(moved[n])
                bearings.append(moved)
                places.append(z)
            for axis in np.eye(3) if s.variance > 0.0 else ():
                moved = z.copy()
                moved[n] += side * math.sqrt(s.variance) * axis
                bearings.append(b)
                places.append(moved)
    R, camera, mask = solve_p3p(np.array(bearings), np.array(places))
    yield from zip(R[mask], camera[mask], strict=True)


def _seen(
    belief: Belief, tick: Tick, sightings: list[Sighting], variance: float, factor: float = CORRELATION_FACTOR
) -> tuple[Sight, Array]:
    """Return sightings as measurements at a pose, and their variances (m,), with those of places times a factor."""
    b, z = np.array([s.bearing for s in sightings]), np.array([s.z for s in sightings])
    sight = belief.sight(b, tick.lever_arm, z, period=tick.dt)
    places = factor * np.array([s.variance for s in sightings]) / sight.distance**2
    return sight, variance + places + sight.bend


def _covariance(belief: Belief, tick: Tick, sightings: list[Sighting], variance: float) -> Array | None:
    """Return the covariance (6, 6) of a pose that is solved from sightings; None if they do not tell it."""
    sight, noise = _seen(belief, tick, sightings, variance)
    M = (np.swapaxes(sight.H, 1, 2) / noise[:, None, None] @ sight.H).sum(axis=0)
    if not condition(M) < MAX_CONDITION:
        return None
    P = invert_positive(M)
    return P if np.diag(P)[:3].max() < 1.0 else None


def _follow(
    bank: list[Hypothesis],
    tick: Tick,
    sightings: list[Sighting],
    variance: float,
    factor: float,
    used: dict[int, tuple[int, ...]] | None = None,
) -> None:
    """Let hypotheses pay for a frame's sightings, but those used to find them, and learn from those that fit.

    They pay by the largest noise that a sighting has for any of them.
    """
    common = np.max([_seen(h.belief, tick, sightings, variance, factor)[1] for h in bank], axis=0)
    for h, hypothesis in enumerate(bank):
        left = [n for n in range(len(sightings)) if n not in (used or {}).get(h, ())]
        if left:
            _follow_one(hypothesis, tick, [sightings[n] for n in left], variance, factor, common[left])


def _follow_one(
    hypothesis: Hypothesis, tick: Tick, sightings: list[Sighting], variance: float, factor: float, common: Array
) -> None:
    """Let one hypothesis pay and learn."""
    belief = hypothesis.belief
    sight, noise = _seen(belief, tick, sightings, variance, factor)
    nis = sight.normalised(belief.P, noise)
    paid = [np.where(sight.ahead, np.minimum(x, MAX_BEARING_COST), MAX_BEARING_COST) for x in
            (nis, sight.normalised(belief.P, common))]  # fmt: skip
    time = np.where([s.variance > 0.0 for s in sightings], CORRELATION_TIME, BEND_TIME)
    lasting = (noise - variance) / np.maximum(time / tick.dt, 1.0)
    hypothesis.misfit += float((paid[0] - 4.0 * (variance + lasting) / noise).sum())
    hypothesis.paid += float(paid[1].sum())
    fits = sight.ahead & (nis < BEARING_GATE)
    if fits.any():
        belief.settle(sight, noise, fits, lambda: _seen(belief, tick, sightings, variance, factor))


def _same(one: Hypothesis, other: Hypothesis) -> bool:
    """Return whether two hypotheses cannot be told apart."""
    a, b = one.belief, other.belief
    e = left_error(a.own.R, a.own.p, b.own.R, b.own.p)
    return float(e.dot(solve(a.P + b.P, e))) < SAME_HYPOTHESIS
