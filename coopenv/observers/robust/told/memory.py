"""What every vehicle's observer remembers besides `robust.memory` of what others tell."""

from typing import Any

import warp as wp

from coopenv.observers.robust.constants import MAX_CORRELATIONS, STEPS
from coopenv.observers.robust.memory import SIZES, CommonMemory, Estimate, Pose, mat66d, mat66f
from coopenv.observers.robust.rules import rules_for, where
from coopenv.world.records import array, extended
from coopenv.world.saved_state import COVARIANCE, FLAG, ROTATION, TICK, Rule, whole


@wp.struct
class Correlation:
    """What a sender tells of its error and that of a vehicle that it hears, see correlations.py."""

    vehicle: wp.int32  # -1: none
    tick: wp.int32  # when the report was sent that the sender has from that vehicle
    matrix: mat66f  # whole numbers, in steps


@wp.struct
class Known:
    """The covariance of a sender's new error with that of a member; scratch, see regression.py."""

    member: wp.int32
    covariance: mat66d
    coefficient: mat66d


@wp.struct
class Alone:
    """Where landmarks and odometry alone put a vehicle, see separation.py."""

    begun: wp.int32  # 0 while the pose is searched for, and where it has been found wrong: it begins anew
    exposed: wp.int32  # whether a sender may have misled the belief since the belief was last this
    tick: wp.int32  # when it was last carried on
    odometry: Pose  # of the belief, then
    estimate: Estimate


ToldMemory = extended(
    CommonMemory,
    "ToldMemory",
    """C correlations in a message.""",
    alone=array("WN", Alone),
    outbox_correlation=array("WNSC", Correlation),
    correlation=array("WNNC", Correlation),  # per receiver and sender
    known=array("WK", Known),  # scratch
    factor=array("WKK", mat66d),  # scratch: blocks of a Cholesky factor, on its diagonal their inverses
)
TOLD_SIZES = {**SIZES, "C": MAX_CORRELATIONS}

VEHICLE = Rule("a vehicle or -1", lambda values, fields, model: (values >= -1) & (values < model.vehicles))
WITHIN = Rule("within its steps", lambda values, fields, model: abs(values) <= STEPS)


def told_rules() -> dict[str, Rule]:
    """Return what a saved memory may hold, see `rules_for`."""
    rules: dict[str, Any] = rules_for(TOLD_SIZES["K"])
    for box in ("outbox_correlation", "correlation"):
        rules |= {f"{box}.vehicle": VEHICLE, f"{box}.tick": TICK, f"{box}.matrix": WITHIN}
    rules |= {"alone.begun": FLAG, "alone.exposed": FLAG, "alone.tick": TICK}
    rules |= where("alone.begun", {"alone.estimate.pose.R": ROTATION, "alone.estimate.P": COVARIANCE})
    rules |= where("alone.begun", {"alone.odometry.R": ROTATION})
    return rules | {"known.member": whole(0, TOLD_SIZES["K"] - 1)}
