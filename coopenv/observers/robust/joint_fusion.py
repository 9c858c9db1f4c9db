"""Fusion of joint messages: new vehicles are added, new information is fused, superseded messages are skipped."""

from typing import Any

import warp as wp

from coopenv.estimation.poses import Coordinates
from coopenv.observers.contract import Observer, Setup
from coopenv.observers.robust import constants, joint_messages
from coopenv.observers.robust.algebra import (
    AFTER,
    BEFORE,
    INVERSE,
    between,
    entry,
    invert,
    left_error,
    moved,
    recentre,
    recentring,
    symmetrise,
    transition,
    with_noise,
)
from coopenv.observers.robust.belief import (
    append_member,
    apply_corrections,
    index_of,
    is_unseen,
    longest_unseen,
    mark_seen,
    most_others,
    remove_member,
    set_block,
    subtract_block,
)
from coopenv.observers.robust.joint_messages import (
    JOINT_SIZES,
    Contact,
    JointMemory,
    clear_joint_messages,
    joint_rules,
    receive_joint,
    send_joint,
)
from coopenv.observers.robust.measurements import is_received
from coopenv.observers.robust.memory import PoseEstimate, mat66d, vec6d
from coopenv.observers.robust.messages import JOINT_MESSAGES
from coopenv.observers.robust.observer import OPTIONS, in_space, make_estimate, make_start
from coopenv.observers.robust.propagation import increment_noise
from coopenv.observers.robust.tracklets import LEAST_TIME, bit_of, information_share, propagate_member, test_sender
from coopenv.world.camera import VISIBLE
from coopenv.world.embedded import Embedded
from coopenv.world.warp_internals import device_function


@device_function
def predict_message(model: Any, memory: Any, world: int, i: int, c: int, count: int):
    """Propagate the contact's last message to the new one by odometry: poses to `scratch`, covariance to BEFORE."""
    sender = memory.contact[world, i, c].sender
    for a in range(count):
        last = memory.contact_broadcast[world, i, c, a]
        broadcast = memory.inbox_broadcast[world, i, sender, a]
        step = between(last.odometry, broadcast.odometry)
        memory.scratch[world, a].pose = moved(last.pose, step)
        memory.scratch[world, a].column = transition(step)
        for b in range(a + 1):
            block = memory.scratch[world, a].column * memory.contact_P[world, i, c, constants.MAX_BROADCAST * a + b]
            block = block * wp.transpose(memory.scratch[world, b].column)
            if a == b:
                dt = wp.float64(wp.max(broadcast.tick - last.tick, 0)) * model.camera_period
                block = with_noise(block, increment_noise(model, memory, world, i, step, dt))
            memory.matrix[world, BEFORE, a, b] = block
            memory.matrix[world, BEFORE, b, a] = wp.transpose(block)


@device_function
def propagate_to_message(model: Any, memory: Any, world: int, i: int, sender: int, count: int):
    """Propagate the members in a message to the times of their poses in it."""
    for a in range(count):
        broadcast = memory.inbox_broadcast[world, i, sender, a]
        n = index_of(memory, world, i, broadcast.vehicle)
        if n > 0:
            last = memory.member[world, i, n].report
            if broadcast.tick > last.tick:
                dt = wp.float64(broadcast.tick - last.tick) * model.camera_period
                step = between(last.odometry, broadcast.odometry)
                noise = increment_noise(model, memory, world, i, step, dt)
                propagate_member(model, memory, world, i, n, step, dt, noise)
                memory.member[world, i, n].report.tick = broadcast.tick
                memory.member[world, i, n].report.odometry = broadcast.odometry


@device_function
def news_of(memory: Any, world: int, i: int, sender: int, count: int, share: Any) -> bool:
    """Turn the covariances BEFORE and AFTER into new information, of which a share counts; return whether there is any.

    Its matrix takes the place of BEFORE, its vector that of the corrections in `scratch`.
    """
    growth = wp.float64(constants.MAX_VARIANCE_GROWTH)
    for k in range(6 * count):
        if entry(memory, world, AFTER, k, k) > growth * entry(memory, world, BEFORE, k, k):
            return False
    invert(memory, world, AFTER, INVERSE, count)
    for a in range(count):  # errors about the propagated poses: of those in the message, and of the members
        broadcast = memory.inbox_broadcast[world, i, sender, a]
        pose = memory.scratch[world, a].pose
        news = left_error(pose, broadcast.pose)
        member = index_of(memory, world, i, broadcast.vehicle)
        memory.scratch[world, a].recentring = recentring(news)
        memory.scratch[world, a].last_correction = news
        memory.scratch[world, a].full_correction = left_error(pose, memory.member[world, i, member].pose)
    recentre(memory, world, INVERSE, count)
    invert(memory, world, BEFORE, AFTER, count)
    for a in range(count):
        for b in range(count):
            new = memory.matrix[world, INVERSE, a, b] - memory.matrix[world, AFTER, a, b]
            memory.matrix[world, BEFORE, a, b] = share * new
    symmetrise(memory, world, BEFORE, count)
    size = wp.float64(0.0)
    for a in range(count):
        vector = vec6d()
        for b in range(count):
            vector += share * (memory.matrix[world, INVERSE, a, b] * memory.scratch[world, b].last_correction)
            vector = vector - memory.matrix[world, BEFORE, a, b] * memory.scratch[world, b].full_correction
        memory.scratch[world, a].correction = vector
        size += wp.dot(vector, vector)
    for a in range(count):  # of the errors about the members, backwards, to second order
        G = recentring(-memory.scratch[world, a].full_correction)
        memory.scratch[world, a].recentring = G
        memory.scratch[world, a].correction = wp.transpose(G) * memory.scratch[world, a].correction
    recentre(memory, world, BEFORE, count)
    return wp.isfinite(size)


@device_function
def fuse_joint_information(memory: Any, world: int, i: int, sender: int, count: int):
    """Fuse information about the errors of all vehicles in a message.

    The matrix BEFORE and the corrections in `scratch` hold it.
    """
    members = memory.belief[world, i].members
    for a in range(count):
        m = index_of(memory, world, i, memory.inbox_broadcast[world, i, sender, a].vehicle)
        for k in range(members):
            memory.blocks[world, k, a] = memory.P[world, i, k, m]
    for a in range(count):
        n = index_of(memory, world, i, memory.inbox_broadcast[world, i, sender, a].vehicle)
        for b in range(count):
            block = mat66d()
            for c in range(count):
                block += memory.blocks[world, n, c] * memory.matrix[world, BEFORE, c, b]
            if a == b:
                block += wp.identity(6, wp.float64)
            memory.matrix[world, AFTER, a, b] = block
    invert(memory, world, AFTER, INVERSE, count)
    for a in range(count):
        along = vec6d()
        for b in range(count):
            along += wp.transpose(memory.matrix[world, INVERSE, b, a]) * memory.scratch[world, b].correction
            product = mat66d()
            for c in range(count):
                product += memory.matrix[world, BEFORE, a, c] * memory.matrix[world, INVERSE, c, b]
            memory.matrix[world, AFTER, a, b] = product
        memory.scratch[world, a].last_correction = along
    symmetrise(memory, world, AFTER, count)
    for k in range(members):
        error = vec6d()
        for b in range(count):
            error += memory.blocks[world, k, b] * memory.scratch[world, b].last_correction
            gain = mat66d()
            for a in range(count):
                gain += memory.blocks[world, k, a] * memory.matrix[world, AFTER, a, b]
            for j in range(k + 1):
                subtract_block(memory, world, i, k, j, gain * wp.transpose(memory.blocks[world, j, b]))
        memory.scratch[world, k].correction = error
    apply_corrections(memory, world, i)


@device_function
def is_in_message(memory: Any, world: int, i: int, sender: int, count: int, vehicle: int) -> bool:
    """Return whether a received message holds a vehicle."""
    for n in range(count):
        if memory.inbox_broadcast[world, i, sender, n].vehicle == vehicle:
            return True
    return False


@device_function
def make_joint_room(model: Any, memory: Any, world: int, i: int, sender: int, count: int, tick: int) -> bool:
    """Remove the members in the message and, if room is needed, those unseen for longest.

    Return False, with nothing changed, if that does not make room for all vehicles in the message.
    """
    own = wp.where(is_in_message(memory, world, i, sender, count, i), 1, 0)
    staying = int(0)
    unseen = int(0)
    for n in range(memory.belief[world, i].others, memory.belief[world, i].members):
        if not is_in_message(memory, world, i, sender, count, memory.member[world, i, n].vehicle):
            staying += 1
            if is_unseen(model, memory, world, i, n, tick):
                unseen += 1
    excess = wp.max(0, staying + count - own - most_others(memory))
    if excess > unseen:
        return False
    for a in range(count):
        n = index_of(memory, world, i, memory.inbox_broadcast[world, i, sender, a].vehicle)
        if n > 0:
            remove_member(memory, world, i, n)
    for _ in range(excess):
        remove_member(memory, world, i, longest_unseen(model, memory, world, i, tick))
    return True


@device_function
def add_joint_members(model: Any, memory: Any, world: int, i: int, sender: int, count: int, tick: int):
    """Add all vehicles in a received message, whose covariance is in AFTER, if there is room."""
    if not make_joint_room(model, memory, world, i, sender, count, tick):
        return
    depends_on = joint_messages.dependence(memory, world, i, sender)
    for a in range(count):
        broadcast = memory.inbox_broadcast[world, i, sender, a]
        if broadcast.vehicle != i:
            n = memory.belief[world, i].members
            append_member(memory, world, i, broadcast.vehicle, broadcast.pose, memory.matrix[world, AFTER, a, a])
            memory.member[world, i, n].report.tick = broadcast.tick
            memory.member[world, i, n].report.odometry = broadcast.odometry
            memory.member[world, i, n].seen_tick = tick
            depends_on = depends_on | bit_of(broadcast.vehicle)
            for b in range(a):
                m = index_of(memory, world, i, memory.inbox_broadcast[world, i, sender, b].vehicle)
                if m > 0:
                    set_block(memory, world, i, n, m, memory.matrix[world, AFTER, a, b])
    memory.belief[world, i].depends_on = memory.belief[world, i].depends_on | depends_on
    c = joint_messages.contact_of(memory, world, i, sender)
    if c < 0:
        c = joint_messages.contact_of(memory, world, i, -1)
    memory.contact[world, i, c] = Contact()
    joint_messages.store_contact(memory, world, i, c, sender, count)
    joint_messages.forget_contacts(memory, world, i)


@device_function
def fuse_joint_message(model: Any, memory: Any, world: int, i: int, c: int, sender: int, count: int):
    """Propagate the vehicles in a message to it, and fuse its information since the contact's last message."""
    broadcast = memory.inbox_broadcast[world, i, sender, 0]
    dt = wp.float64(broadcast.tick - memory.contact_broadcast[world, i, c, 0].tick) * model.camera_period
    if dt <= wp.float64(LEAST_TIME):  # too early after the sender's last fused message
        return
    predict_message(model, memory, world, i, c, count)
    joint_messages.store_contact(memory, world, i, c, sender, count)
    propagate_to_message(model, memory, world, i, sender, count)
    n = index_of(memory, world, i, sender)
    was_excluded = memory.contact[world, i, c].excluded
    joint_messages.note_contacts(memory, world, i)
    now = PoseEstimate(broadcast.pose, memory.matrix[world, AFTER, 0, 0])
    test_sender(memory, world, i, n, now, dt)
    memory.contact[world, i, c].excluded = memory.member[world, i, n].excluded
    memory.contact[world, i, c].agreement_time = memory.member[world, i, n].agreement_time
    if was_excluded == 1 or memory.contact[world, i, c].excluded == 1:
        return
    depends_on = memory.contact[world, i, c].depends_on
    if news_of(memory, world, i, sender, count, information_share(memory, world, i, depends_on)):
        fuse_joint_information(memory, world, i, sender, count)
        memory.belief[world, i].depends_on = memory.belief[world, i].depends_on | depends_on


@device_function
def includes_visible(model: Any, state: Any, memory: Any, world: int, i: int, sender: int) -> bool:
    """Return whether a received message holds a vehicle in view."""
    for n in range(joint_messages.vehicles_in(memory, world, i, sender)):
        if state.sight[world, i, model.landmarks + memory.inbox_broadcast[world, i, sender, n].vehicle] == VISIBLE:
            return True
    return False


@device_function
def fuse_one(model: Any, state: Any, memory: Any, world: int, i: int, sender: int, tick: int):
    """Fuse one message, or add its vehicles; skip it if another message supersedes it."""
    count = joint_messages.vehicles_in(memory, world, i, sender)
    joint_messages.read_covariance(memory, world, i, sender, count)
    c = joint_messages.contact_of(memory, world, i, sender)
    if joint_messages.is_superseded(model, memory, world, i, sender, count):
        if c >= 0:
            joint_messages.store_contact(memory, world, i, c, sender, count)
        return
    if joint_messages.includes_the_same(memory, world, i, c, sender, count):
        fuse_joint_message(model, memory, world, i, c, sender, count)
    elif c >= 0 or includes_visible(model, state, memory, world, i, sender):
        add_joint_members(model, memory, world, i, sender, count, tick)
    c = joint_messages.contact_of(memory, world, i, sender)
    if c >= 0:
        memory.contact[world, i, c].fused = 1


@device_function
def fuse_joint_messages(model: Any, state: Any, memory: Any, world: int, i: int, tick: int):
    """Fuse the messages about members and add the vehicles in those of senders in view, the largest messages first."""
    joint_messages.forget_contacts(memory, world, i)  # the belief may have begun anew
    mark_seen(model, state, memory, world, i, tick)
    for c in range(memory.contact.shape[2]):
        memory.contact[world, i, c].fused = 1
    for n in range(model.target_count[i]):
        sender = model.targets[i, n] - model.landmarks
        if is_received(model, state, memory, world, i, sender, tick):
            c = joint_messages.contact_of(memory, world, i, sender)
            if c >= 0:
                memory.contact[world, i, c].fused = 0
                if includes_visible(model, state, memory, world, i, sender):  # all vehicles in it then count as seen
                    for k in range(joint_messages.vehicles_in(memory, world, i, sender)):
                        m = index_of(memory, world, i, memory.inbox_broadcast[world, i, sender, k].vehicle)
                        if m > 0:
                            memory.member[world, i, m].seen_tick = tick
    for fewer in range(constants.MAX_BROADCAST):
        for n in range(model.target_count[i]):
            sender = model.targets[i, n] - model.landmarks
            if is_received(model, state, memory, world, i, sender, tick):
                if joint_messages.vehicles_in(memory, world, i, sender) == constants.MAX_BROADCAST - fewer:
                    fuse_one(model, state, memory, world, i, sender, tick)
    joint_messages.forget_contacts(memory, world, i)
    joint_messages.note_contacts(memory, world, i)


@device_function
def accept(model: Any, state: Any, memory: Any, world: int, i: int, now: Any):
    """Accept the belief: its members are estimated along with the vehicle itself."""


ROBUST_JOINT = Embedded(
    "robust_joint",
    make_estimate(receive_joint, fuse_joint_messages, accept),
    make_start(clear_joint_messages, receive_joint),
    send_joint,
    JointMemory,
    JOINT_SIZES,
    valid=joint_rules(),
    messages=JOINT_MESSAGES,
    coordinates=Coordinates.LEFT,
    options=OPTIONS,
)


def robust_joint(setup: Setup) -> Observer:
    """The robust observer with larger, joint messages, for vehicles in space.

    Raises:
        CoopenvError: the vehicle moves on a plane and its odometry is its commands.
    """
    return in_space("robust_joint", ROBUST_JOINT, setup)
