"""The last message of every sender that tells of members of the belief alone."""

from __future__ import annotations

from typing import Any

import warp as wp

from coopenv.observers.robust.belief import index_of
from coopenv.observers.robust.constants import SAME_TIME, SUPERSEDING_TIME
from coopenv.observers.robust.joint.matrices import AFTER
from coopenv.observers.robust.joint.memory import DIMENSION
from coopenv.observers.robust.joint.radio import dependence

MAX_AGE = SUPERSEDING_TIME + SAME_TIME


@wp.func
def contact_of(memory: Any, world: int, i: int, sender: int) -> int:
    """Return the contact with a sender, -1 if there is none."""
    for c in range(memory.contact.shape[2]):
        if memory.contact[world, i, c].sender == sender:
            return c
    return -1


@wp.func
def store_contact(memory: Any, world: int, i: int, c: int, sender: int, count: int):
    """Let the message that has been read be the last one of a contact."""
    memory.contact[world, i, c].sender = sender
    memory.contact[world, i, c].count = count
    memory.contact[world, i, c].depends_on = dependence(memory, world, i, sender)
    for n in range(count):
        memory.contact_told[world, i, c, n] = memory.told[world, n]
    for k in range(6 * count):
        for j in range(6 * count):
            e = k * DIMENSION + j
            memory.contact_P[world, i, c, e] = memory.matrix[world, AFTER, e]


@wp.func
def tells_of(memory: Any, world: int, i: int, c: int, vehicle: int) -> bool:
    """Return whether the last message of a contact tells of a vehicle."""
    for n in range(memory.contact[world, i, c].count):
        if memory.contact_told[world, i, c, n].vehicle == vehicle:
            return True
    return False


@wp.func
def tells_of_the_same(memory: Any, world: int, i: int, c: int, count: int) -> bool:
    """Return whether the message that has been read tells of the vehicles that the contact's last one tells of."""
    if memory.contact[world, i, c].count != count:
        return False
    for n in range(count):
        if memory.contact_told[world, i, c, n].vehicle != memory.told[world, n].vehicle:
            return False
    return True


@wp.func
def is_superseded(model: Any, memory: Any, world: int, i: int, sender: int, count: int) -> bool:
    """Return whether a message that is fused already says all that the one that has been read does."""
    for c in range(memory.contact.shape[2]):
        other = memory.contact[world, i, c].sender
        if other >= 0 and other != sender and memory.contact[world, i, c].fused == 1:
            later = memory.told[world, 0].tick - memory.contact_told[world, i, c, 0].tick
            recent = wp.float64(later) * model.camera_period <= wp.float64(MAX_AGE)
            more = memory.contact[world, i, c].count > count or other < sender
            if recent and more and tells_of(memory, world, i, c, sender):
                return True
    return False


@wp.func
def forget_contacts(memory: Any, world: int, i: int):
    """Forget the senders that tell of vehicles which are no members; they may be met again."""
    for c in range(memory.contact.shape[2]):
        for n in range(memory.contact[world, i, c].count):
            vehicle = memory.contact_told[world, i, c, n].vehicle
            if vehicle != i and index_of(memory, world, i, vehicle) == 0:
                memory.contact[world, i, c].sender = -1


@wp.func
def note_contacts(memory: Any, world: int, i: int):
    """Let the members show what their contacts say: whether they are trusted, and on whom they depend."""
    for n in range(1, memory.belief[world, i].members):
        c = contact_of(memory, world, i, memory.member[world, i, n].vehicle)
        memory.member[world, i, n].distrusted = 0
        memory.member[world, i, n].report.depends_on = wp.uint64(0)
        if c >= 0:
            memory.member[world, i, n].distrusted = memory.contact[world, i, c].distrusted
            memory.member[world, i, n].agreement_time = memory.contact[world, i, c].agreement_time
            memory.member[world, i, n].report.depends_on = memory.contact[world, i, c].depends_on
