"""How far a sender is off by clocks that disagree, along its way."""

from __future__ import annotations

import numpy as np

from coopenv.estimation.arrays import Array
from coopenv.observers.robust.constants import LEAST_CHANGE, SHARE_OF_CHANGE
from tests.oracles.robust.belief import Belief, Member


def by_clocks(member: Member, std: float) -> Array:
    """Return (6, 6) the covariance of how far a member is off by clocks of a deviation (s), along its velocity."""
    P = np.zeros((6, 6))
    if member.dated is not None:
        P[3:, 3:] = 2.0 * std**2 * np.outer(member.dated, member.dated)
    return P


def changes_speed(belief: Belief, n: int, std: float) -> bool:
    """Let clocks of a deviation (s) count by member n's velocity where that has changed much; return whether it has."""
    member, block = belief.members[n], slice(6 * n, 6 * n + 6)
    dated = np.zeros(3) if member.dated is None else member.dated
    assert member.v is not None
    limit = SHARE_OF_CHANGE * float(np.linalg.norm(dated)) + LEAST_CHANGE
    if std == 0.0 or float(np.linalg.norm(member.v - dated)) <= limit:
        return False
    member.dated = member.v
    belief.P[block, block] += by_clocks(member, std)
    return True
