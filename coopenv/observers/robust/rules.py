"""What a saved memory may hold, by field, see `coopenv.world.saved_state`."""

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


def where(used: str, rules: dict[str, Rule]) -> dict[str, Rule]:
    """Return rules that count where a field of the memory says so."""
    return {name: rule._replace(used=f"observer_{used}") for name, rule in rules.items()}


def _others(rule: Rule) -> Rule:
    """Return the rule of what is kept of the other members, not of the vehicle itself."""
    return rule._replace(holds=lambda v, *rest: np.insert(rule.holds(v[:, :, 1:], *rest), 0, True, axis=2))


LARGE = numbers(LARGEST**3)


def rules_for(members: int) -> dict[str, Rule]:
    """Return the rules of a memory with so many members; numbers that are not in it have to be finite."""
    flags = "search.active outbox.valid inbox.valid member.has_twist member.distrusted member.report.valid line.fits"
    ticks = "member.seen_tick member.report.tick anchor.tick outbox.tick inbox.tick"
    large = (
        "hypothesis.cost hypothesis.prior_distance line.variance line.noise scratch.column scratch.PHt scratch_blocks"
    )
    rules = {
        **dict.fromkeys(flags.split(), FLAG),
        **dict.fromkeys(ticks.split(), TICK),
        **dict.fromkeys(large.split(), LARGE),
        **dict.fromkeys(("belief.odometry.R", "anchor.estimate.pose.R", "anchor.odometry.R"), ROTATION),
        **dict.fromkeys(("search.attempts", "hypothesis.bearings"), whole(0, 10**9)),
        "belief.members": whole(1, members),
        "P": Rule("a covariance", _joint_covariances, axes=4),
        "anchor.estimate.P": COVARIANCE,
        "search.hypotheses": whole(0, MAX_HYPOTHESES),
        "line.member": whole(-1, members - 1),
        **where("belief.members", {"member.pose.R": ROTATION, "member.vehicle": whole(0, "vehicles")}),
        **where("search.active", {"search.prior.pose.R": ROTATION, "search.prior.P": COVARIANCE}),
        **where("search.hypotheses", {"hypothesis.estimate.pose.R": ROTATION, "hypothesis.estimate.P": COVARIANCE}),
    }
    reports = {"pose.R": ROTATION, "P": COVARIANCE, "odometry.R": ROTATION}
    for box in ("outbox", "inbox"):
        rules |= where(f"{box}.valid", {f"{box}.{name}": rule for name, rule in reports.items()})
    return rules | where("belief.members", {f"member.report.{name}": _others(rule) for name, rule in reports.items()})
