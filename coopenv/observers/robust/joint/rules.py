"""What a saved memory may hold besides, see `robust.rules`."""

from typing import Any

import numpy as np

from coopenv.estimation.validity import are_covariances
from coopenv.observers.robust.constants import MAX_MEMBERS_JOINT, MAX_TOLD
from coopenv.observers.robust.joint.memory import DIMENSION
from coopenv.observers.robust.rules import LARGE, rules_for, where
from coopenv.world.saved_state import FLAG, LEAST_EIGENVALUE, ROTATION, TICK, Rule, whole


def _contact_covariances(values: Any, fields: Any, model: Any) -> Any:
    """Return (W, N, K) which blocks (W, N, K, E, 6, 6) are covariances of the vehicles that a contact tells of."""
    used = np.arange(DIMENSION) < 6 * fields["observer_contact.count"][..., None]
    P = values.reshape(*values.shape[:3], MAX_TOLD, MAX_TOLD, 6, 6).swapaxes(-3, -2)
    P = P.reshape(*values.shape[:3], DIMENSION, DIMENSION)
    covariance = np.where(used[..., :, None] & used[..., None, :], P, np.eye(DIMENSION))
    return are_covariances(covariance, LEAST_EIGENVALUE[values.dtype])


VEHICLE = Rule("a vehicle", lambda values, fields, model: (values >= 0) & (values < model.vehicles))
SENDER = Rule("a vehicle or -1", lambda values, fields, model: (values >= -1) & (values < model.vehicles))


def joint_rules() -> dict[str, Rule]:
    """Return the rules of the whole memory."""
    rules = {
        **rules_for(MAX_MEMBERS_JOINT),
        "contact.sender": SENDER,
        "contact.count": whole(0, MAX_TOLD),
        "contact_P": Rule("a covariance", _contact_covariances, axes=3),
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
