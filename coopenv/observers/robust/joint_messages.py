"""Joint messages of up to `MAX_BROADCAST` vehicles: sending, receiving, reading, and the last one of every sender.

A contact is the last message of a sender, if all vehicles in it are members of the belief.
"""

from typing import Any

import warp as wp

from coopenv.observers.robust import constants
from coopenv.observers.robust.algebra import AFTER, entry, factorise
from coopenv.observers.robust.belief import index_of
from coopenv.observers.robust.memory import (
    LARGE,
    MOUNTING,
    SIZES,
    VEHICLE,
    CommonMemory,
    Pose,
    are_joint,
    fill,
    fill_rows,
    mat66d,
    rules_for,
    vec3d,
    where,
)
from coopenv.observers.robust.tracklets import includes, make_receive, marker_jacobian, own_report
from coopenv.world.state import FLAG, ROTATION, TICK, Rule, array, extended, whole
from coopenv.world.v2x import claimed_std
from coopenv.world.warp_internals import device_function


@wp.struct
class BroadcastVehicle:
    """A vehicle in a joint message."""

    vehicle: wp.int32
    tick: wp.int32  # of its pose
    pose: Pose
    odometry: Pose


@wp.struct
class JointHeader:
    """The part of a joint message beside the sender's own report."""

    count: wp.int32  # of vehicles in it, the sender included
    complete: wp.int32  # whether these are all members of the sender's belief


@wp.struct
class Contact:
    """The last joint message of a sender."""

    sender: wp.int32  # -1: none
    count: wp.int32  # of vehicles in it, the sender included
    depends_on: wp.uint64
    excluded: wp.int32
    agreement_time: wp.float64  # s for which an excluded sender has agreed
    fused: wp.int32  # whether it is part of the belief at this tick


JointMemory = extended(
    CommonMemory,
    "JointMemory",
    """T vehicles in a message, its sender first.

    Their covariances are matrices of E blocks; messages hold the F numbers of the Cholesky factor, row by row.
    """,
    outbox_joint=array("WNS", JointHeader),
    outbox_broadcast=array("WNST", BroadcastVehicle),
    outbox_factor=array("WNSF", wp.float32),
    inbox_joint=array("WNN", JointHeader),
    inbox_broadcast=array("WNNT", BroadcastVehicle),
    inbox_factor=array("WNNF", wp.float32),
    contact=array("WNK", Contact),
    contact_broadcast=array("WNKT", BroadcastVehicle),
    contact_P=array("WNKE", mat66d),  # blocks, row by row
    matrix=array("WXTT", mat66d),  # scratch
    blocks=array("WKT", mat66d),  # scratch: columns of the covariance
)

DIMENSION = 6 * constants.MAX_BROADCAST
JOINT_SIZES = {
    **SIZES,
    "K": constants.MAX_MEMBERS_JOINT + MOUNTING,
    "T": constants.MAX_BROADCAST,
    "E": constants.MAX_BROADCAST**2,
    "F": DIMENSION * (DIMENSION + 1) // 2,
    "X": 3,
}


def _are_in_message(P: Any, fields: Any, model: Any) -> Any:
    """Return (W, N, K) which blocks (W, N, K, E, 6, 6) are covariances of the vehicles of a contact."""
    T = constants.MAX_BROADCAST
    return are_joint(P.reshape(*P.shape[:3], T, T, 6, 6), fields["observer_contact.count"])


MEMBER = Rule("a vehicle", lambda values, fields, model: (values >= 0) & (values < model.vehicles))


def joint_rules() -> dict[str, Rule]:
    """Return what a saved memory may hold, see `rules_for`."""
    rules = {
        **rules_for(JOINT_SIZES["K"]),
        "contact.sender": VEHICLE,
        "contact_P": Rule("a covariance", _are_in_message, axes=3),
        **dict.fromkeys(("contact.excluded", "contact.fused", "outbox_joint.complete", "inbox_joint.complete"), FLAG),
        **dict.fromkeys(("matrix", "blocks"), LARGE),
    }
    counts = {"outbox": "outbox_joint.count", "inbox": "inbox_joint.count", "contact": "contact.count"}
    for box, count in counts.items():
        rules |= where(count, {f"{box}_broadcast.pose.R": ROTATION, f"{box}_broadcast.odometry.R": ROTATION})
        rules |= {
            f"{box}_broadcast.vehicle": MEMBER,
            f"{box}_broadcast.tick": TICK,
            count: whole(0, constants.MAX_BROADCAST),
        }
    return rules


MAX_AGE = constants.SUPERSEDING_TIME + constants.SAME_TIME


@device_function
def clear_joint_messages(model: Any, memory: Any, world: int, i: int):
    """Clear all joint messages, contacts and scratch arrays."""
    none = Contact()
    none.sender = -1
    fill(memory.contact[world, i], none)
    fill_rows(memory.contact_broadcast[world, i], BroadcastVehicle())
    fill_rows(memory.contact_P[world, i], mat66d())
    fill(memory.outbox_joint[world, i], JointHeader())
    fill_rows(memory.outbox_broadcast[world, i], BroadcastVehicle())
    fill_rows(memory.outbox_factor[world, i], wp.float32(0.0))
    fill(memory.inbox_joint[world, i], JointHeader())
    fill_rows(memory.inbox_broadcast[world, i], BroadcastVehicle())
    fill_rows(memory.inbox_factor[world, i], wp.float32(0.0))
    fill_rows(memory.blocks[world], mat66d())
    for x in range(memory.matrix.shape[1]):
        fill_rows(memory.matrix[world, x], mat66d())


@device_function
def send_joint(model: Any, state: Any, memory: Any, world: int, i: int, tick: int):
    """Send the belief about the vehicle itself and as many other members as fit, if a message is due."""
    if tick % model.radio.period != 0:
        return
    slot = tick % model.radio.slots
    report = own_report(model, state, memory, world, i, tick)
    joint = JointHeader()
    if report.valid == 1:
        others = memory.belief[world, i].others
        members = memory.belief[world, i].members - others + 1  # without the odometry's errors
        count = wp.min(members, constants.MAX_BROADCAST)
        write_covariance(model, state, memory, world, i, count, tick)
        if factorise(memory, world, AFTER, 6 * count):
            joint = JointHeader(count, wp.where(count == members, 1, 0))
            for k in range(6 * count):
                for j in range(k + 1):
                    number = wp.float32(entry(memory, world, AFTER, k, j))
                    memory.outbox_factor[world, i, slot, (k * (k + 1)) // 2 + j] = number
            memory.outbox_broadcast[world, i, slot, 0] = BroadcastVehicle(i, tick, report.pose, report.odometry)
            for n in range(1, count):
                other = memory.member[world, i, others + n - 1]
                broadcast = BroadcastVehicle(other.vehicle, other.report.tick, other.pose, other.report.odometry)
                memory.outbox_broadcast[world, i, slot, n] = broadcast
        else:
            report.valid = 0
    memory.outbox[world, i, slot] = report
    memory.outbox_joint[world, i, slot] = joint


@device_function
def write_covariance(model: Any, state: Any, memory: Any, world: int, i: int, count: int, tick: int):
    """Write the covariance of the own error at the marker and of the first other members' to AFTER.

    A `lie` fault that claims a standard deviation replaces the own covariance and removes the cross-covariances.
    """
    claimed = wp.float64(claimed_std(model, state, world, i, tick))
    J = marker_jacobian(vec3d(model.scene.marker[model.landmarks + i]))
    others = memory.belief[world, i].others
    for a in range(count):
        for b in range(count):
            block = memory.P[world, i, wp.where(a > 0, others - 1 + a, 0), wp.where(b > 0, others - 1 + b, 0)]
            if a == 0:
                block = J * block
            if b == 0:
                block = block * wp.transpose(J)
            if claimed > wp.float64(0.0) and (a == 0 or b == 0):
                block = wp.where(a == b, claimed * claimed, wp.float64(0.0)) * wp.identity(6, wp.float64)
            memory.matrix[world, AFTER, a, b] = block


@device_function
def copy_joint(memory: Any, world: int, i: int, sender: int, slot: int, later: int):
    """Copy the joint part of a message, with ticks `later`: ages are broadcast, not ticks."""
    memory.inbox_joint[world, i, sender] = memory.outbox_joint[world, sender, slot]
    count = memory.outbox_joint[world, sender, slot].count
    for n in range(count):
        memory.inbox_broadcast[world, i, sender, n] = memory.outbox_broadcast[world, sender, slot, n]
        memory.inbox_broadcast[world, i, sender, n].tick += later
    for k in range(3 * count * (6 * count + 1)):
        memory.inbox_factor[world, i, sender, k] = memory.outbox_factor[world, sender, slot, k]


receive_joint = make_receive(copy_joint)


@device_function
def vehicles_in(memory: Any, world: int, i: int, sender: int) -> int:
    """Return the number of vehicles in a received message that count: 1 if the sender depends on this vehicle."""
    if includes(memory.inbox[world, i, sender].depends_on, i):
        return 1
    return memory.inbox_joint[world, i, sender].count


@device_function
def dependence(memory: Any, world: int, i: int, sender: int) -> wp.uint64:
    """Return the vehicles on which a received message depends: none if it holds the whole belief of its sender."""
    depends_on = memory.inbox[world, i, sender].depends_on
    if memory.inbox_joint[world, i, sender].complete == 1 and not includes(depends_on, i):
        return wp.uint64(0)
    return depends_on


@device_function
def read_covariance(memory: Any, world: int, i: int, sender: int, count: int):
    """Write the covariance of the vehicles in a received message to AFTER."""
    if includes(memory.inbox[world, i, sender].depends_on, i):
        memory.matrix[world, AFTER, 0, 0] = mat66d(memory.inbox[world, i, sender].P)
        return
    for k in range(6 * count):
        for j in range(k + 1):
            total = wp.float64(0.0)  # the square of the factor
            for c in range(j + 1):
                left = wp.float64(memory.inbox_factor[world, i, sender, (k * (k + 1)) // 2 + c])
                total += left * wp.float64(memory.inbox_factor[world, i, sender, (j * (j + 1)) // 2 + c])
            memory.matrix[world, AFTER, k // 6, j // 6][k % 6, j % 6] = total
            memory.matrix[world, AFTER, j // 6, k // 6][j % 6, k % 6] = total


@device_function
def contact_of(memory: Any, world: int, i: int, sender: int) -> int:
    """Return the contact with a sender, -1 if there is none."""
    for c in range(memory.contact.shape[2]):
        if memory.contact[world, i, c].sender == sender:
            return c
    return -1


@device_function
def store_contact(memory: Any, world: int, i: int, c: int, sender: int, count: int):
    """Store the received message of a sender, whose covariance is in AFTER, as the last one of a contact."""
    memory.contact[world, i, c].sender = sender
    memory.contact[world, i, c].count = count
    memory.contact[world, i, c].depends_on = dependence(memory, world, i, sender)
    for n in range(count):
        memory.contact_broadcast[world, i, c, n] = memory.inbox_broadcast[world, i, sender, n]
    for a in range(count):
        for b in range(count):
            memory.contact_P[world, i, c, constants.MAX_BROADCAST * a + b] = memory.matrix[world, AFTER, a, b]


@device_function
def includes_the_same(memory: Any, world: int, i: int, c: int, sender: int, count: int) -> bool:
    """Return whether there is a contact whose last message holds the same vehicles as the received one."""
    if c < 0 or memory.contact[world, i, wp.max(c, 0)].count != count:
        return False
    for n in range(count):
        if memory.contact_broadcast[world, i, c, n].vehicle != memory.inbox_broadcast[world, i, sender, n].vehicle:
            return False
    return True


@device_function
def is_superseded(model: Any, memory: Any, world: int, i: int, sender: int, count: int) -> bool:
    """Return whether a message that is fused already holds the sender of the received one."""
    for c in range(memory.contact.shape[2]):
        other = memory.contact[world, i, c].sender
        if other >= 0 and other != sender and memory.contact[world, i, c].fused == 1:
            later = memory.inbox_broadcast[world, i, sender, 0].tick - memory.contact_broadcast[world, i, c, 0].tick
            recent = wp.float64(later) * model.camera_period <= wp.float64(MAX_AGE)
            more = memory.contact[world, i, c].count > count or other < sender
            if recent and more:
                for n in range(memory.contact[world, i, c].count):
                    if memory.contact_broadcast[world, i, c, n].vehicle == sender:
                        return True
    return False


@device_function
def forget_contacts(memory: Any, world: int, i: int):
    """Clear the contacts with vehicles that are no members; they may begin anew."""
    for c in range(memory.contact.shape[2]):
        for n in range(memory.contact[world, i, c].count):
            vehicle = memory.contact_broadcast[world, i, c, n].vehicle
            if vehicle != i and index_of(memory, world, i, vehicle) == 0:
                memory.contact[world, i, c].sender = -1


@device_function
def note_contacts(memory: Any, world: int, i: int):
    """Copy exclusion and dependence of the contacts to the members."""
    for n in range(memory.belief[world, i].others, memory.belief[world, i].members):
        c = contact_of(memory, world, i, memory.member[world, i, n].vehicle)
        memory.member[world, i, n].excluded = 0
        memory.member[world, i, n].report.depends_on = wp.uint64(0)
        if c >= 0:
            memory.member[world, i, n].excluded = memory.contact[world, i, c].excluded
            memory.member[world, i, n].agreement_time = memory.contact[world, i, c].agreement_time
            memory.member[world, i, n].report.depends_on = memory.contact[world, i, c].depends_on
