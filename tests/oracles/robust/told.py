"""What senders tell of how their errors correlate with others', and what follows from it."""

from __future__ import annotations

import numpy as np

from coopenv.estimation.arrays import Array, cholesky
from coopenv.observers.contract import Message
from coopenv.observers.robust.constants import (
    MAX_CONTRADICTION,
    RELATIVE_NOISE,
    ROUNDING,
    STEPS,
)
from tests.oracles.robust.belief import ERRORS, Belief, errors_of


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


class Correlations:
    """What was told last, by sender and by the vehicle that it was told of: factor(P_s)^-1 C factor(P_o)^-T."""

    def __init__(self) -> None:
        """Start with none."""
        self.told: dict[int, dict[int, Array]] = {}

    def hear(self, sender: int, message: Message) -> None:
        """Note what a message tells."""
        told, matrices = message.extra.get("told", ()), message.extra.get("correlations", ())
        self.told[sender] = {
            int(vehicle): np.asarray(C, float) / STEPS for vehicle, C in zip(told, matrices, strict=True)
        }

    def crosses(self, belief: Belief, n: int, after: Array, met: bool) -> dict[int, Array]:
        """Return the covariances (6, 6) of a sender's new error with those of other members, as far as they are told.

        By the sender itself; where the two have just met also by the other; and where neither hears the other, by both
        about a third one, of those the one that they depend on most.
        """
        mine = self.told.get(belief.members[n].vehicle, {})
        A, result = factor(after), {}
        for k, member in enumerate(belief.members):
            if k in (0, n) or member.vehicle == ERRORS:
                continue
            theirs = self.told.get(member.vehicle, {})
            C = _correlation(mine, theirs, belief.members[n].vehicle, member.vehicle, met)
            if C is not None:
                result[k] = A.dot(C).dot(factor(belief.P[6 * k : 6 * k + 6, 6 * k : 6 * k + 6]).T)
        return result


def _correlation(mine: dict[int, Array], theirs: dict[int, Array], sender: int, other: int, met: bool) -> Array | None:
    """Return the correlation of the errors of a sender and another one, None if it is not known."""
    if other in mine:
        return mine[other]
    if sender in theirs:
        return theirs[sender].T if met else None
    shared = [mine[v].dot(theirs[v].T) for v in mine if v in theirs]
    return max(shared, key=lambda C: float((C * C).sum())) if shared else None


def regress(
    P: Array, n: int, after: Array, crosses: dict[int, Array], heard: bool, least: float
) -> tuple[Array, float]:
    """Return (6, 6m) the covariance of member n's new error with all errors, and what is forgiven the sender.

    Known is its covariance `after`, that with the errors of which `crosses` tells and, where the sender was heard
    before, that with its error then, which is `after`, too. Regressed on these errors it correlates with the others as
    they do, and the joint covariance stays positive definite, if what is left over is. Where that is not so, a share of
    its covariance is forgiven; else less is taken as known; -1: nothing is left.
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
        for needed, forgiven in ((0.0, least), (MAX_CONTRADICTION, MAX_CONTRADICTION)):
            if is_positive(left + needed * after):
                row = L.dot(P[index])
                row[:, block] = (1.0 + forgiven) * after
                return row, forgiven
    row = np.zeros((6, len(P)))
    row[:, block] = after
    return row, -1.0
