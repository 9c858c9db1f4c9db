"""Every message of a tick: whether its vehicles are new, its information is new, or another message has said it."""

from typing import Any

import warp as wp

from coopenv.observers.robust.belief import (
    append_member,
    index_of,
    is_unseen,
    longest_unseen,
    mark_seen,
    most_others,
    remove_member,
)
from coopenv.observers.robust.constants import MAX_TOLD
from coopenv.observers.robust.joint import radio
from coopenv.observers.robust.joint.information import fuse_joint_information, news_of, predict_told, propagate_told
from coopenv.observers.robust.joint.matrices import AFTER
from coopenv.observers.robust.joint.memory import Contact
from coopenv.observers.robust.measurements import is_heard
from coopenv.observers.robust.memory import Estimate
from coopenv.observers.robust.tracklets import bit_of, information_share, is_due, test_sender
from coopenv.world.camera import VISIBLE
from coopenv.world.device_function import device_function


@device_function
def is_told(memory: Any, world: int, count: int, vehicle: int) -> bool:
    """Return whether the message that has been read tells of a vehicle."""
    for n in range(count):
        if memory.told[world, n].vehicle == vehicle:
            return True
    return False


@device_function
def make_joint_room(model: Any, memory: Any, world: int, i: int, tick: int, count: int) -> bool:
    """Remove the members that the message tells of and, for want of room, those unseen for longest.

    Return False, with nothing changed, if that does not make room for all that the message tells of.
    """
    own = wp.where(is_told(memory, world, count, i), 1, 0)
    staying = int(0)
    unseen = int(0)
    for n in range(memory.belief[world, i].others, memory.belief[world, i].members):
        if not is_told(memory, world, count, memory.member[world, i, n].vehicle):
            staying += 1
            if is_unseen(model, memory, world, i, n, tick):
                unseen += 1
    excess = wp.max(0, staying + count - own - most_others(memory))
    if excess > unseen:
        return False
    for a in range(count):
        n = index_of(memory, world, i, memory.told[world, a].vehicle)
        if n > 0:
            remove_member(memory, world, i, n)
    for _ in range(excess):
        remove_member(memory, world, i, longest_unseen(model, memory, world, i, tick))
    return True


@device_function
def add_joint_members(model: Any, memory: Any, world: int, i: int, sender: int, count: int, tick: int):
    """Add all that the message that has been read tells of, if there is room; their errors are as it says."""
    if not make_joint_room(model, memory, world, i, tick, count):
        return
    depends_on = radio.dependence(memory, world, i, sender)
    for a in range(count):
        told = memory.told[world, a]
        if told.vehicle != i:
            n = memory.belief[world, i].members
            append_member(memory, world, i, told.vehicle, told.pose, memory.matrix[world, AFTER, a, a])
            memory.member[world, i, n].report.tick = told.tick
            memory.member[world, i, n].report.odometry = told.odometry
            memory.member[world, i, n].seen_tick = tick
            depends_on = depends_on | bit_of(told.vehicle)
            for b in range(a):
                m = index_of(memory, world, i, memory.told[world, b].vehicle)
                if m > 0:
                    block = memory.matrix[world, AFTER, a, b]
                    memory.P[world, i, n, m] = block
                    memory.P[world, i, m, n] = wp.transpose(block)
    memory.belief[world, i].depends_on = memory.belief[world, i].depends_on | depends_on
    c = radio.contact_of(memory, world, i, sender)
    if c < 0:
        c = radio.contact_of(memory, world, i, -1)
    memory.contact[world, i, c] = Contact()
    radio.store_contact(memory, world, i, c, sender, count)
    radio.forget_contacts(memory, world, i)


@device_function
def fuse_joint_message(model: Any, memory: Any, world: int, i: int, c: int, sender: int, count: int):
    """Carry all that a message tells of to it, and fuse what has been learnt since the contact's last message."""
    ticks = memory.told[world, 0].tick - memory.contact_told[world, i, c, 0].tick
    if not is_due(model, memory.contact_told[world, i, c, 0].tick, memory.told[world, 0].tick):
        return
    predict_told(model, memory, world, i, c, count)
    radio.store_contact(memory, world, i, c, sender, count)
    propagate_told(model, memory, world, i, count)
    n = index_of(memory, world, i, sender)
    told = memory.told[world, 0]
    was_distrusted = memory.contact[world, i, c].distrusted
    radio.note_contacts(memory, world, i)
    now = Estimate(told.pose, memory.matrix[world, AFTER, 0, 0])
    test_sender(memory, world, i, n, now, wp.float64(ticks) * model.camera_period)
    memory.contact[world, i, c].distrusted = memory.member[world, i, n].distrusted
    memory.contact[world, i, c].agreement_time = memory.member[world, i, n].agreement_time
    if was_distrusted == 1 or memory.contact[world, i, c].distrusted == 1:
        return
    depends_on = memory.contact[world, i, c].depends_on
    if news_of(memory, world, i, count, information_share(memory, world, i, depends_on)):
        fuse_joint_information(memory, world, i, count)
        memory.belief[world, i].depends_on = memory.belief[world, i].depends_on | depends_on


@device_function
def told_vehicle(memory: Any, world: int, i: int, sender: int, n: int) -> int:
    """Return the n-th vehicle of which a received message tells, the sender first."""
    if n == 0:
        return sender
    return memory.inbox_told[world, i, sender, n - 1].vehicle


@device_function
def tells_of_visible(model: Any, state: Any, memory: Any, world: int, i: int, sender: int) -> bool:
    """Return whether a received message tells of a vehicle in view."""
    for n in range(radio.others_told(memory, world, i, sender) + 1):
        if state.sight[world, i, model.landmarks + told_vehicle(memory, world, i, sender, n)] == VISIBLE:
            return True
    return False


@device_function
def fuse_one(model: Any, state: Any, memory: Any, world: int, i: int, sender: int, tick: int):
    """Fuse one message, or add those that it tells of, or neither where another message has said it all."""
    count = radio.read_message(memory, world, i, sender)
    c = radio.contact_of(memory, world, i, sender)
    if radio.is_superseded(model, memory, world, i, sender, count):
        if c >= 0:
            radio.store_contact(memory, world, i, c, sender, count)
        return
    if radio.tells_of_the_same(memory, world, i, c, count):
        fuse_joint_message(model, memory, world, i, c, sender, count)
    elif c >= 0 or tells_of_visible(model, state, memory, world, i, sender):
        add_joint_members(model, memory, world, i, sender, count, tick)
    c = radio.contact_of(memory, world, i, sender)
    if c >= 0:
        memory.contact[world, i, c].fused = 1


@device_function
def fuse_joint_messages(model: Any, state: Any, memory: Any, world: int, i: int, tick: int):
    """Fuse the messages that tell of members, and add those that vehicles in view tell of; who tells of most first."""
    radio.forget_contacts(memory, world, i)  # the belief may have begun anew
    mark_seen(model, state, memory, world, i, tick)
    for c in range(memory.contact.shape[2]):
        memory.contact[world, i, c].fused = 1
    for n in range(model.target_count[i]):
        sender = model.targets[i, n] - model.landmarks
        if sender >= 0 and is_heard(model, state, memory, world, i, wp.max(sender, 0), tick):
            c = radio.contact_of(memory, world, i, sender)
            if c >= 0:
                memory.contact[world, i, c].fused = 0
                if tells_of_visible(model, state, memory, world, i, sender):  # then all that it tells of count as seen
                    for k in range(radio.others_told(memory, world, i, sender) + 1):
                        m = index_of(memory, world, i, told_vehicle(memory, world, i, sender, k))
                        if m > 0:
                            memory.member[world, i, m].seen_tick = tick
    for fewer in range(MAX_TOLD):
        for n in range(model.target_count[i]):
            sender = model.targets[i, n] - model.landmarks
            if sender >= 0 and is_heard(model, state, memory, world, i, wp.max(sender, 0), tick):
                if radio.others_told(memory, world, i, sender) == MAX_TOLD - 1 - fewer:
                    fuse_one(model, state, memory, world, i, sender, tick)
    radio.forget_contacts(memory, world, i)
    radio.note_contacts(memory, world, i)
