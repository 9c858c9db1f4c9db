"""What senders tell of how their errors correlate with others', and what follows from it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from coopenv.estimation.arrays import Array, cholesky
from coopenv.observers.contract import Message
from coopenv.observers.robust.constants import (
    LEAST_CONTRADICTION,
    MAX_CONTRADICTION,
    RELATIVE_NOISE,
    ROUNDING,
    STEPS,
)
from tests.oracles.robust.belief import Belief, Member, errors_of


def factor(P: Array) -> Array:
    """Return the lower Cholesky factor."""
    return cholesky(P)


def is_positive(P: Array) -> bool:
    """Return whether a matrix is positive definite, by more than rounding."""
    try:
        L = np.linalg.cholesky(P)
    except np.linalg.LinAlgError:
        return False
    return bool((L.diagonal() ** 2 > ROUNDING * P.diagonal()).all())


class Told(NamedTuple):
    """What a sender has told of a vehicle."""

    correlation: Array  # (6, 6) factor(P_s)^-1 C factor(P_o)^-T
    time: float  # s, of the report that it has from that vehicle


class Correlations:
    """What was told last, by sender and by the vehicle that it was told of."""

    def __init__(self) -> None:
        """Start with none."""
        self.told: dict[int, dict[int, Told]] = {}

    def hear(self, sender: int, message: Message, time: float) -> None:
        """Note what a message tells, if it tells of correlations."""
        if "told" in message.extra:
            told = zip(*(message.extra[name] for name in ("told", "ages", "correlations")), strict=True)
            self.told[sender] = {int(v): Told(np.asarray(C, float) / STEPS, time - float(age)) for v, age, C in told}

    def of(self, sender: int, vehicle: int) -> Told | None:
        """Return what a sender has told of a vehicle."""
        return self.told.get(sender, {}).get(vehicle)

    def crosses(self, belief: Belief, n: int, after: Array, met: bool) -> dict[int, Array]:
        """Return the covariances (6, 6) of a sender's new error with those of other members that are told."""
        A, result = factor(after), {}
        for k, member in enumerate(belief.members):
            if k in (0, n) or member.vehicle < 0:
                continue
            C = self._correlation(belief.members[n], member, met)
            if C is not None:
                result[k] = A.dot(C).dot(factor(belief.P[6 * k : 6 * k + 6, 6 * k : 6 * k + 6]).T)
        return result

    def _correlation(self, one: Member, other: Member, met: bool) -> Array | None:
        """Return the correlation of the errors of a sender and another one, None if it is not known.

        By the sender itself; where the two have just met also by the other; and where neither hears the other, by both
        about a third one, of those the one that they depend on most.
        """
        told = self.of(one.vehicle, other.vehicle)
        if told is not None:
            return told.correlation if is_same(told.time, other.time) else None
        told = self.of(other.vehicle, one.vehicle)
        if told is not None:
            return told.correlation.T if met and is_same(told.time, one.time) else None
        shared = []
        for vehicle, mine in self.told.get(one.vehicle, {}).items():
            theirs = self.of(other.vehicle, vehicle)
            if theirs is not None and is_same(mine.time, theirs.time):
                shared.append(mine.correlation.dot(theirs.correlation.T))
        return max(shared, key=lambda C: float((C * C).sum())) if shared else None


def is_same(time: float, other: float) -> bool:
    """Return whether two times are that of the same report; they travel in single precision."""
    return abs(time - other) < 1e-4


def regress(
    P: Array, n: int, after: Array, crosses: dict[int, Array], heard: bool, least: float
) -> tuple[Array, float]:
    """Return (6, 6m) the covariance of member n's new error with all errors, and what is forgiven the sender.

    Known is its covariance `after`, that with the errors of which `crosses` tells and, where the sender was heard
    before, that with its error then, which is `after`, too. Regressed on these errors it correlates with the others as
    they do, and the joint covariance stays positive definite, if what is left over is. Where that is not so, a share of
    its covariance is forgiven; else less is taken as known; -1: nothing is left, and the error before has grown.
    """
    block = slice(6 * n, 6 * n + 6)
    for used in (crosses, {}) if crosses else ({},):
        places = [n] * heard + list(used)
        if not places:
            break
        index = errors_of(places)
        J = P[np.ix_(index, index)]
        right = np.hstack([after] * heard + list(used.values()))
        L = np.linalg.solve(J + RELATIVE_NOISE * np.diag(J.diagonal()), right.T).T
        left = after - L.dot(J).dot(L.T)
        for needed in (0.0, *np.geomspace(LEAST_CONTRADICTION, MAX_CONTRADICTION, 4)):
            if is_positive(left + needed * after):
                forgiven = max(float(needed), least)
                row = L.dot(P[index]) * np.sqrt((1.0 + forgiven) / (1.0 + needed))
                row[:, block] = (1.0 + forgiven) * after
                return row, forgiven
    row = np.zeros((6, len(P)))
    if heard:
        row = factor(after).dot(np.linalg.solve(factor(P[block, block]), P[block]))
    row[:, block] = after
    return row, -1.0
