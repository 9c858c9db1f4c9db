"""What a saved memory may hold, by field, see `coopenv.world.saved_state`."""

from __future__ import annotations

from typing import Any

import numpy as np

from coopenv.estimation.validity import are_covariances
from coopenv.observers.robust.constants import MAX_HYPOTHESES
from coopenv.scenario.base import LARGEST
from coopenv.world.saved_state import COVARIANCE, FLAG, LEAST_EIGENVALUE, ROTATION, TICK, Rule, numbers, whole

MEMBERS = "observer_belief.members"


def _joint_covariances(values: Any, fields: Any, model: Any) -> Any:
    """Return (W, N) which blocks (W, N, K, K, 6, 6) are covariances, those of no member left out."""
    K, n = values.shape[-3], values.shape[-1]
    used = np.repeat(np.arange(K) < fields[MEMBERS][..., None], n, axis=-1)
    P = np.swapaxes(values, -3, -2).reshape(*values.shape[:2], K * n, K * n)
    joint = np.where(used[..., :, None] & used[..., None, :], P, np.eye(K * n))
    return are_covariances(joint, LEAST_EIGENVALUE[values.dtype])


def where(used: str, **rules: Rule) -> dict[str, Rule]:
    """Return rules of fields of `record__field` that count where a field of the memory says so."""
    return {name.replace("__", "."): rule._replace(used=f"observer_{used}") for name, rule in rules.items()}


def _others(rule: Rule) -> Rule:
    """Return the rule of what is kept of the other members, not of the vehicle itself."""
    return rule._replace(holds=lambda v, *rest: np.insert(rule.holds(v[:, :, 1:], *rest), 0, True, axis=2))


LARGE = numbers(LARGEST**3)


def rules_for(members: int) -> dict[str, Rule]:
    """Return the rules of a memory with so many members; numbers that are not in it have to be finite."""
    return {
        "belief.odometry.R": ROTATION,
        "belief.members": whole(1, members),
        "P": Rule("a covariance", _joint_covariances, axes=4),
        "member.seen_tick": TICK,
        "member.report.tick": TICK,
        "anchor.estimate.pose.R": ROTATION,
        "anchor.estimate.P": COVARIANCE,
        "anchor.odometry.R": ROTATION,
        "anchor.tick": TICK,
        "search.active": FLAG,
        "search.hypotheses": whole(0, MAX_HYPOTHESES),
        "search.attempts": whole(0, 10**9),
        "hypothesis.bearings": whole(0, 10**9),
        "outbox.tick": TICK,
        "outbox.valid": FLAG,
        "inbox.valid": FLAG,
        "inbox.tick": TICK,
        "line.member": whole(-1, members - 1),
        **dict.fromkeys(("member.has_twist", "member.distrusted", "member.report.valid", "line.fits"), FLAG),
        **where("belief.members", member__pose__R=ROTATION, member__vehicle=whole(0, "vehicles")),
        **where(
            "belief.members",
            member__report__pose__R=_others(ROTATION),
            member__report__P=_others(COVARIANCE),
            member__report__odometry__R=_others(ROTATION),
        ),
        **where("search.active", search__prior__pose__R=ROTATION, search__prior__P=COVARIANCE),
        **where("search.hypotheses", hypothesis__estimate__pose__R=ROTATION, hypothesis__estimate__P=COVARIANCE),
        **where("outbox.valid", outbox__pose__R=ROTATION, outbox__P=COVARIANCE, outbox__odometry__R=ROTATION),
        **where("inbox.valid", inbox__pose__R=ROTATION, inbox__P=COVARIANCE, inbox__odometry__R=ROTATION),
        **dict.fromkeys(("hypothesis.cost", "hypothesis.prior_distance", "line.variance", "line.noise"), LARGE),
        **dict.fromkeys(("scratch.column", "scratch.PHt", "scratch_blocks"), LARGE),
    }
