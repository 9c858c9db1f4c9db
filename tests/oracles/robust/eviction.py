"""Who must be forgotten so that others fit into a belief: those that have been out of view for longest."""

from __future__ import annotations

from coopenv.observers.robust.constants import FORGET_TIME, SAME_TIME
from tests.oracles.robust.belief import Belief


def room_for(belief: Belief, vehicles: set[int], most: int, time: float) -> set[int] | None:
    """Return the members that must go so that vehicles fit, the longest unseen first; None if they cannot fit.

    Args:
        belief: some of the vehicles may be in it already.
        vehicles: who come in, all at once.
        most: how many members a belief may have, the vehicle itself included.
        time: now, s.
    """
    others = belief.members[belief.others :]
    staying = [member for member in others if member.vehicle not in vehicles]
    unseen = [member for member in staying if time - member.seen > FORGET_TIME + SAME_TIME]
    excess = max(0, 1 + len(staying) + len(vehicles) - most)
    if excess > len(unseen):
        return None
    return {member.vehicle for member in sorted(unseen, key=lambda member: member.seen)[:excess]}
