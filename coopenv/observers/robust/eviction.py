"""Who must be forgotten so that another one fits into a belief. See reference/eviction.py."""

from __future__ import annotations

from typing import Any

import warp as wp

from coopenv.observers.robust.belief import place_of
from coopenv.observers.robust.reference.belief import AT_ONCE
from coopenv.observers.robust.reference.eviction import FORGET_TIME
from coopenv.world.camera import VISIBLE

LONGEST_UNSEEN = wp.constant(FORGET_TIME + AT_ONCE)


@wp.func
def notice(model: Any, state: Any, mind: Any, world: int, i: int, tick: int):
    """Remember which members are in view."""
    for n in range(model.target_count[i]):
        target = model.targets[i, n]
        if target >= model.landmarks and state.sight[world, i, target] == VISIBLE:
            place = place_of(mind, world, i, target - model.landmarks)
            if place > 0:
                mind.seen_tick[world, i, place] = tick


@wp.func
def longest_unseen(model: Any, mind: Any, world: int, i: int, tick: int) -> int:
    """Return the member that has been out of view for longest, 0 if all have been in view lately."""
    found = int(0)
    for n in range(1, mind.members[world, i]):
        unseen = wp.float64(tick - mind.seen_tick[world, i, n]) * model.camera_period
        if unseen > wp.float64(LONGEST_UNSEEN):
            if found == 0 or mind.seen_tick[world, i, n] < mind.seen_tick[world, i, found]:
                found = n
    return found


@wp.func
def copy_member(mind: Any, world: int, i: int, n: int, to: int):
    """Put a member in the place of another one, but for the covariance."""
    mind.vehicle[world, i, to] = mind.vehicle[world, i, n]
    mind.R[world, i, to] = mind.R[world, i, n]
    mind.p[world, i, to] = mind.p[world, i, n]
    mind.twists[world, i, to] = mind.twists[world, i, n]
    mind.v[world, i, to] = mind.v[world, i, n]
    mind.w[world, i, to] = mind.w[world, i, n]
    mind.seen_tick[world, i, to] = mind.seen_tick[world, i, n]
    mind.report_tick[world, i, to] = mind.report_tick[world, i, n]
    mind.report_rotation[world, i, to] = mind.report_rotation[world, i, n]
    mind.report_position[world, i, to] = mind.report_position[world, i, n]
    mind.report_covariance[world, i, to] = mind.report_covariance[world, i, n]
    mind.report_odometry_rotation[world, i, to] = mind.report_odometry_rotation[world, i, n]
    mind.report_odometry_position[world, i, to] = mind.report_odometry_position[world, i, n]
    mind.report_leans_on[world, i, to] = mind.report_leans_on[world, i, n]
    mind.distrusted[world, i, to] = mind.distrusted[world, i, n]
    mind.agreed[world, i, to] = mind.agreed[world, i, n]


@wp.func
def drop(mind: Any, world: int, i: int, n: int):
    """Forget a member; those behind it move up."""
    members = mind.members[world, i]
    for m in range(n + 1, members):
        copy_member(mind, world, i, m, m - 1)
        for k in range(members):
            mind.P[world, i, m - 1, k] = mind.P[world, i, m, k]
    for m in range(n + 1, members):
        for k in range(members):
            mind.P[world, i, k, m - 1] = mind.P[world, i, k, m]
    mind.members[world, i] = members - 1


@wp.func
def make_room(model: Any, mind: Any, world: int, i: int, tick: int) -> bool:
    """Return whether there is room for one more, for which the member unseen for longest may have to go."""
    if mind.members[world, i] < mind.vehicle.shape[2]:
        return True
    n = longest_unseen(model, mind, world, i, tick)
    if n == 0:
        return False
    drop(mind, world, i, n)
    return True
