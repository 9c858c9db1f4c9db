"""Which member has to leave a belief so that another vehicle fits in: the one that has been out of view for longest."""

from __future__ import annotations

from typing import Any

import warp as wp

from coopenv.observers.robust.belief import index_of, remove_member
from coopenv.observers.robust.constants import FORGET_TIME, SAME_TIME
from coopenv.world.camera import VISIBLE

MAX_UNSEEN_TIME = FORGET_TIME + SAME_TIME


@wp.func
def mark_seen(model: Any, state: Any, memory: Any, world: int, i: int, tick: int):
    """Note which members are in view."""
    for n in range(model.target_count[i]):
        target = model.targets[i, n]
        if target >= model.landmarks and state.sight[world, i, target] == VISIBLE:
            member = index_of(memory, world, i, target - model.landmarks)
            if member > 0:
                memory.member[world, i, member].seen_tick = tick


@wp.func
def longest_unseen(model: Any, memory: Any, world: int, i: int, tick: int) -> int:
    """Return the member that has been out of view for longest, 0 if all have been in view lately."""
    found = int(0)
    for n in range(1, memory.belief[world, i].members):
        seen = memory.member[world, i, n].seen_tick
        if wp.float64(tick - seen) * model.camera_period > wp.float64(MAX_UNSEEN_TIME):
            if found == 0 or seen < memory.member[world, i, found].seen_tick:
                found = n
    return found


@wp.func
def make_room(model: Any, memory: Any, world: int, i: int, tick: int) -> bool:
    """Return whether there is room for one more, after an eviction if there has to be one and may be one."""
    if memory.belief[world, i].members < memory.member.shape[2]:
        return True
    n = longest_unseen(model, memory, world, i, tick)
    if n == 0:
        return False
    remove_member(memory, world, i, n)
    return True
