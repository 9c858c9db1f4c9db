"""What every vehicle's observer remembers besides `robust.memory`, where messages tell of several vehicles."""

from typing import Any

import warp as wp

from coopenv.observers.robust.constants import MAX_MEMBERS_JOINT, MAX_TOLD
from coopenv.observers.robust.memory import MOUNTING, SIZES, CommonMemory, Pose, mat66d
from coopenv.observers.robust.rules import LARGE, are_joint, rules_for, where
from coopenv.world.records import array, extended
from coopenv.world.saved_state import FLAG, ROTATION, TICK, Rule, whole


@wp.struct
class Told:
    """One of the vehicles that a joint message tells of."""

    vehicle: wp.int32
    tick: wp.int32  # at which it stands
    pose: Pose
    odometry: Pose


@wp.struct
class Joint:
    """What a joint message has besides the sender's own report."""

    others: wp.int32  # how many other vehicles it tells of
    complete: wp.int32  # whether these are all that the sender believes in


@wp.struct
class Contact:
    """The last joint message of a sender."""

    sender: wp.int32  # -1: none
    count: wp.int32  # of vehicles that it tells of, the sender included
    depends_on: wp.uint64
    distrusted: wp.int32
    agreement_time: wp.float64  # s for which a distrusted sender has agreed
    fused: wp.int32  # whether it is part of the belief at this tick


JointMemory = extended(
    CommonMemory,
    "JointMemory",
    """T vehicles that a message tells of, B of them others than its sender.

    Of their covariances, matrices of E blocks, as much counts as there are vehicles; they travel as F numbers of the
    Cholesky factor, row by row.
    """,
    outbox_joint=array("WNS", Joint),
    outbox_told=array("WNSB", Told),
    outbox_factor=array("WNSF", wp.float32),
    inbox_joint=array("WNN", Joint),
    inbox_told=array("WNNB", Told),
    inbox_factor=array("WNNF", wp.float32),
    contact=array("WNK", Contact),
    contact_told=array("WNKT", Told),  # the sender first
    contact_P=array("WNKE", mat66d),  # blocks, row by row
    told=array("WT", Told),  # scratch: of the message that is read
    step=array("WT", Pose),  # scratch: the last report of each carried on by odometry
    matrix=array("WXTT", mat66d),  # scratch
    blocks=array("WKT", mat66d),  # scratch: columns of the covariance
)

DIMENSION = 6 * MAX_TOLD
JOINT_SIZES = {
    **SIZES,
    "K": MAX_MEMBERS_JOINT + MOUNTING,
    "T": MAX_TOLD,
    "B": MAX_TOLD - 1,
    "E": MAX_TOLD**2,
    "F": DIMENSION * (DIMENSION + 1) // 2,
    "X": 3,
}


def _are_told(P: Any, fields: Any, model: Any) -> Any:
    """Return (W, N, K) which blocks (W, N, K, E, 6, 6) are covariances of the vehicles that a contact tells of."""
    return are_joint(P.reshape(*P.shape[:3], MAX_TOLD, MAX_TOLD, 6, 6), fields["observer_contact.count"])


VEHICLE = Rule("a vehicle", lambda values, fields, model: (values >= 0) & (values < model.vehicles))
SENDER = Rule("a vehicle or -1", lambda values, fields, model: (values >= -1) & (values < model.vehicles))


def joint_rules() -> dict[str, Rule]:
    """Return what a saved memory may hold, see `rules_for`."""
    rules = {
        **rules_for(JOINT_SIZES["K"]),
        "contact.sender": SENDER,
        "contact.count": whole(0, MAX_TOLD),
        "contact_P": Rule("a covariance", _are_told, axes=3),
        **dict.fromkeys(("contact.distrusted", "contact.fused"), FLAG),
        **dict.fromkeys(("matrix", "blocks"), LARGE),
    }
    counts = {"outbox": "outbox_joint.others", "inbox": "inbox_joint.others", "contact": "contact.count"}
    for box, count in counts.items():
        rules |= where(count, {f"{box}_told.pose.R": ROTATION, f"{box}_told.odometry.R": ROTATION})
        rules |= {f"{box}_told.vehicle": VEHICLE, f"{box}_told.tick": TICK}
        if box != "contact":
            rules |= {f"{box}_joint.others": whole(0, MAX_TOLD - 1), f"{box}_joint.complete": FLAG}
    return rules | {"told.vehicle": VEHICLE, "told.tick": TICK}
