"""What senders tell of how their errors correlate with others', and what follows from it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np

from coopenv.estimation.arrays import Array, cholesky
from coopenv.observers.contract import Message
from coopenv.observers.robust.constants import (
    LEAST_LEFT,
    RELATIVE_NOISE,
    ROUNDING,
    STEPS,
    TOLD_TIME,
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


class Crosses(NamedTuple):
    """Covariances (6, 6) of a sender's error with those of other members, by member."""

    told: dict[int, Array]
    likely: dict[int, Array]


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

    def has_to_wait(self, sender: int, pending: Iterable[int], taken: Mapping[int, float]) -> bool:
        """Return whether a report has to wait for another one, so that all fit what is told of them.

        It has to where it tells of another pending sender's report that is not taken yet, and where another one's
        tells of the report that was taken of the sender last. `taken` are the times of those, s.
        """
        for other in pending:
            if other != sender:
                told, theirs = self.of(sender, other), self.of(other, sender)
                if told is not None and told.time > taken[other] and not is_same(told.time, taken[other]):
                    return True
                if theirs is not None and is_same(theirs.time, taken[sender]):
                    return True
        return False

    def crosses(self, belief: Belief, n: int, after: Array, met: bool) -> Crosses:
        """Return the covariances (6, 6) of a sender's new error with those of other members."""
        A, result = factor(after), Crosses({}, {})
        for k, member in enumerate(belief.members):
            if k in (0, n) or not member.considered:
                continue
            C, told = self._correlation(belief.members[n], member, met)
            if C is not None:
                covariance = A.dot(C).dot(factor(belief.P[6 * k : 6 * k + 6, 6 * k : 6 * k + 6]).T)
                (result.told if told else result.likely)[k] = covariance
        return result

    def _correlation(self, one: Member, other: Member, met: bool) -> tuple[Array | None, bool]:
        """Return the correlation of the errors of a sender and another one, None if it is not known; and if it is told.

        By the sender itself; where the two have just met also by the other; and where neither hears the other, by both
        about a third one, of those the one that they depend on most: then it is only likely.
        """
        told = self.of(one.vehicle, other.vehicle)
        if told is not None:
            return (told.correlation if is_near(told.time, other.time) else None), True
        told = self.of(other.vehicle, one.vehicle)
        if told is not None:
            return (told.correlation.T if met and is_near(told.time, one.time) else None), True
        shared = []
        for vehicle, mine in self.told.get(one.vehicle, {}).items():
            theirs = self.of(other.vehicle, vehicle)
            if theirs is not None and is_near(mine.time, theirs.time):
                shared.append(mine.correlation.dot(theirs.correlation.T))
        return max(shared, key=lambda C: float((C * C).sum()), default=None), False


def is_same(time: float, other: float) -> bool:
    """Return whether two times are that of the same report; they travel in single precision."""
    return abs(time - other) < 1e-4


def is_near(time: float, other: float) -> bool:
    """Return whether what is told of a report of one time counts for that of another."""
    return abs(time - other) < TOLD_TIME


class Regressed(NamedTuple):
    """What is made of a sender's new error."""

    row: Array  # (6, 6m) its covariance with all errors
    more: Array  # (6, 6) by how much its own is larger than the sender says
    told: bool  # whether anything is known of it beside its past


def regress(P: Array, n: int, after: Array, crosses: Crosses, heard: bool, least: float) -> Regressed:
    """Return what is made of member n's new error, of covariance `after`.

    Known is that with the errors of `crosses` and, where the sender was heard before, that with its error then, which
    is `after`, too. Regressed on these errors it correlates with the others as they do, and the joint covariance stays
    positive definite, if what is left over is. Where it is not, what is only likely does not count, and then `after` is
    enlarged in those directions; by the share `least` in all, by the same error.
    """
    told = {**({n: after} if heard else {}), **crosses.told}
    known, L, left = told | crosses.likely, np.zeros((6, 0)), after
    for known in (told | crosses.likely, told) if told and crosses.likely else (told | crosses.likely,):
        if not known:
            break
        index = errors_of(list(known))
        J = P[np.ix_(index, index)]
        L = np.linalg.solve(J + RELATIVE_NOISE * np.diag(J.diagonal()), np.hstack(list(known.values())).T).T
        left = after - L.dot(J).dot(L.T)
        if is_positive(left - LEAST_LEFT * after):
            break
    row, more = np.zeros((6, len(P))), np.zeros((6, 6))
    if known:
        row = np.sqrt(1.0 + least) * L.dot(P[errors_of(list(known))])
        more = (1.0 + least) * (after + excess(left, after)) - after
    row[:, 6 * n : 6 * n + 6] = after + more
    return Regressed(row, more, bool(set(known) - {n}))


def excess(left: Array, after: Array) -> Array:
    """Return the least (6, 6) that makes what is left over of a covariance at least a share of it in all directions."""
    if is_positive(left - LEAST_LEFT * after):
        return np.zeros((6, 6))
    A = factor(after)
    values, axes = np.linalg.eigh(np.linalg.solve(A, np.linalg.solve(A, left).T))
    B = A.dot(axes)
    return np.asarray((B * np.maximum(LEAST_LEFT - values, 0.0)).dot(B.T))
