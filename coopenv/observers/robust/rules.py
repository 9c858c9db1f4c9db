"""What a saved memory may hold."""

from typing import Any

import numpy as np

from coopenv.estimation.validity import are_covariances
from coopenv.observers.robust.constants import MAX_HYPOTHESES, MAX_OFFENCES
from coopenv.observers.robust.memory import MOUNTING
from coopenv.scenario.base import LARGEST
from coopenv.world.saved_state import COVARIANCE, FLAG, LEAST_EIGENVALUE, ROTATION, TICK, Rule, numbers, whole

LARGE = numbers(LARGEST**3)


def are_joint(blocks: Any, count: Any) -> Any:
    """Return (...) which blocks (..., K, K, 6, 6) are covariances, as far as they count (...)."""
    K = blocks.shape[-3]
    used = np.repeat(np.arange(K) < count[..., None], 6, axis=-1)
    P = np.swapaxes(blocks, -3, -2).reshape(*count.shape, 6 * K, 6 * K)
    joint = np.where(used[..., :, None] & used[..., None, :], P, np.eye(6 * K))
    return are_covariances(joint, LEAST_EIGENVALUE[blocks.dtype])


def where(used: str, rules: dict[str, Rule]) -> dict[str, Rule]:
    """Return rules that count where a field of the memory says so."""
    return {name: rule._replace(used=f"observer_{used}") for name, rule in rules.items()}


def _others(rule: Rule) -> Rule:
    """Return the rule of what is kept of the other vehicles, not of the vehicle itself and its odometry's errors."""

    def holds(values: Any, fields: Any, model: Any) -> Any:
        others = fields["observer_belief.others"][..., None]
        mask = np.asarray(rule.holds(values, fields, model))
        of_own = np.arange(values.shape[2]) < others
        return mask | of_own.reshape(*of_own.shape, *(1,) * (mask.ndim - of_own.ndim))

    return rule._replace(holds=holds)


def rules_for(members: int) -> dict[str, Rule]:
    """Return what a saved memory with so many members may hold, by field, see `coopenv.world.saved_state`."""
    flags = (
        "search.active outbox.valid inbox.valid belief.has_sample member.has_twist member.distrusted "
        "member.considered member.untold outbox.news inbox.news member.report.news member.report.valid line.fits "
        "belief.accused_followed word.perjured"
    )
    ticks = "member.seen_tick member.report.tick anchor.tick outbox.tick inbox.tick"
    large = (
        "hypothesis.cost hypothesis.misfit hypothesis.prior_distance line.variance line.noise line.common_noise "
        "line.weight scratch.column gain word.certainty"
    )
    rules = {
        **dict.fromkeys(flags.split(), FLAG),
        **dict.fromkeys(ticks.split(), TICK),
        **dict.fromkeys(large.split(), LARGE),
        **dict.fromkeys(("belief.odometry.R", "anchor.estimate.pose.R", "anchor.odometry.R"), ROTATION),
        **dict.fromkeys(("search.attempts", "belief.told_interval"), whole(0, 10**9)),
        "word.offences": whole(0, MAX_OFFENCES),
        "word.barred_until": whole(0, 2**31 - 1),
        "belief.members": whole(1, members),
        "belief.accused": whole(0, 0),
        "belief.others": whole(1, MOUNTING + 1),
        "P": Rule("a covariance", lambda P, fields, model: are_joint(P, fields["observer_belief.members"]), axes=4),
        "anchor.estimate.P": COVARIANCE,
        "search.hypotheses": whole(0, MAX_HYPOTHESES),
        **dict.fromkeys(("line.member", "line.teller"), whole(0, members - 1)),
        "line.mounting": whole(0, MOUNTING),
        **where("belief.members", {"member.pose.R": ROTATION, "member.vehicle": whole(0, "vehicles")}),
        **where("search.active", {"search.prior.pose.R": ROTATION, "search.prior.P": COVARIANCE}),
        **where("search.hypotheses", {"hypothesis.estimate.pose.R": ROTATION, "hypothesis.estimate.P": COVARIANCE}),
    }
    reports = {"pose.R": ROTATION, "P": COVARIANCE, "odometry.R": ROTATION}
    for box in ("outbox", "inbox"):
        rules |= where(f"{box}.valid", {f"{box}.{name}": rule for name, rule in reports.items()})
    return rules | where("belief.members", {f"member.report.{name}": _others(rule) for name, rule in reports.items()})
