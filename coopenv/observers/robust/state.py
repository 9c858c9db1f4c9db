"""What every vehicle's observer remembers: one record of arrays with leading axes (world, vehicle)."""

from typing import Any

import numpy as np
import warp as wp

from coopenv.observers.robust.reference.observer import Robust
from coopenv.observers.robust.reference.search import MOST_HYPOTHESES
from coopenv.observers.robust.types import mat26d, mat33d, mat62d, mat66d, mat66f, vec2d, vec3d, vec6d
from coopenv.scenario.base import LARGEST
from coopenv.world.saved_state import COVARIANCE, FLAG, JOINT_COVARIANCE, ROTATION, TICK, Rule, numbers, whole

MOST_MEMBERS = wp.constant(Robust.most_members)
MOST_SUPPOSED = wp.constant(MOST_HYPOTHESES)
"""Hypotheses that one frame gives, or that are followed."""
SPARE_PLACE = wp.constant(MOST_HYPOTHESES + 1)
BANK_PLACES = wp.constant(MOST_HYPOTHESES + 2)
"""What one frame gives, the prior, and a spare place."""


@wp.struct
class RobustState:
    """W worlds, N vehicles, M members of a belief (the vehicle itself first), H hypotheses, S slots of the radio.

    Left errors (theta, rho) in rad and m; positions in the map frame; float64 in worlds of any precision.
    """

    start_covariance: wp.array2d(dtype=mat66d)  # (W, N) of the initial estimate
    odometry_rotation: wp.array2d(dtype=mat33d)  # (W, N) pose by dead reckoning, in a frame of its own
    odometry_position: wp.array2d(dtype=vec3d)  # (W, N)

    members: wp.array2d(dtype=wp.int32)  # (W, N) how many are in the belief
    vehicle: wp.array3d(dtype=wp.int32)  # (W, N, M)
    R: wp.array3d(dtype=mat33d)  # (W, N, M)
    p: wp.array3d(dtype=vec3d)  # (W, N, M)
    P: wp.array4d(dtype=mat66d)  # (W, N, M, M) blocks of the joint covariance
    twists: wp.array3d(dtype=wp.int32)  # (W, N, M) whether a twist is known
    v: wp.array3d(dtype=vec3d)  # (W, N, M) m/s, body
    w: wp.array3d(dtype=vec3d)  # (W, N, M) rad/s, body
    seen_tick: wp.array3d(dtype=wp.int32)  # (W, N, M) when a member was last in view
    report_tick: wp.array3d(dtype=wp.int32)  # (W, N, M) last report of a member: when it was sent
    report_rotation: wp.array3d(dtype=mat33d)  # (W, N, M)
    report_position: wp.array3d(dtype=vec3d)  # (W, N, M)
    report_covariance: wp.array3d(dtype=mat66d)  # (W, N, M)
    report_odometry_rotation: wp.array3d(dtype=mat33d)  # (W, N, M)
    report_odometry_position: wp.array3d(dtype=vec3d)  # (W, N, M)
    report_leans_on: wp.array3d(dtype=wp.uint64)  # (W, N, M)
    distrusted: wp.array3d(dtype=wp.int32)  # (W, N, M)
    agreed: wp.array3d(dtype=wp.float64)  # (W, N, M) s since which a distrusted sender has agreed
    leans_on: wp.array2d(dtype=wp.uint64)  # (W, N) bits of vehicles
    missed: wp.array2d(dtype=wp.float64)  # (W, N) mean share of bearings that do not fit
    healthy: wp.array2d(dtype=wp.float64)  # (W, N) s since which it has been low
    anchor_rotation: wp.array2d(dtype=mat33d)  # (W, N) where the vehicle was then
    anchor_position: wp.array2d(dtype=vec3d)  # (W, N)
    anchor_covariance: wp.array2d(dtype=mat66d)  # (W, N)
    anchor_odometry_rotation: wp.array2d(dtype=mat33d)  # (W, N)
    anchor_odometry_position: wp.array2d(dtype=vec3d)  # (W, N)
    anchor_tick: wp.array2d(dtype=wp.int32)  # (W, N)

    searching: wp.array2d(dtype=wp.int32)  # (W, N)
    prior_rotation: wp.array2d(dtype=mat33d)  # (W, N)
    prior_position: wp.array2d(dtype=vec3d)  # (W, N)
    prior_covariance: wp.array2d(dtype=mat66d)  # (W, N)
    hypotheses: wp.array2d(dtype=wp.int32)  # (W, N) how many
    bank_rotation: wp.array3d(dtype=mat33d)  # (W, N, H)
    bank_position: wp.array3d(dtype=vec3d)  # (W, N, H)
    bank_covariance: wp.array3d(dtype=mat66d)  # (W, N, H)
    paid: wp.array3d(dtype=wp.float64)  # (W, N, H)
    surprise: wp.array3d(dtype=wp.float64)  # (W, N, H) squared distance from the prior
    bearings: wp.array3d(dtype=wp.int32)  # (W, N, H) for which it has paid
    age: wp.array2d(dtype=wp.float64)  # (W, N) s, for which hypotheses have been followed
    waited: wp.array2d(dtype=wp.float64)  # (W, N) s, for which there were none
    clear: wp.array2d(dtype=wp.float64)  # (W, N) s, for which the last frames' solutions have been well determined
    attempts: wp.array2d(dtype=wp.int32)  # (W, N)

    outbox_says: wp.array3d(dtype=wp.int32)  # (W, N, S) 0: an empty message
    outbox_rotation: wp.array3d(dtype=mat33d)  # (W, N, S)
    outbox_position: wp.array3d(dtype=vec3d)  # (W, N, S) of the marker
    outbox_covariance: wp.array3d(dtype=mat66f)  # (W, N, S)
    outbox_odometry_rotation: wp.array3d(dtype=mat33d)  # (W, N, S)
    outbox_odometry_position: wp.array3d(dtype=vec3d)  # (W, N, S) of the marker
    outbox_leans_on: wp.array3d(dtype=wp.uint64)  # (W, N, S)
    inbox_tick: wp.array3d(dtype=wp.int32)  # (W, N receiver, N sender) of sending; -1: never heard
    inbox_says: wp.array3d(dtype=wp.int32)  # (W, N, N)
    inbox_rotation: wp.array3d(dtype=mat33d)  # (W, N, N)
    inbox_position: wp.array3d(dtype=vec3d)  # (W, N, N)
    inbox_covariance: wp.array3d(dtype=mat66f)  # (W, N, N)
    inbox_odometry_rotation: wp.array3d(dtype=mat33d)  # (W, N, N)
    inbox_odometry_position: wp.array3d(dtype=vec3d)  # (W, N, N)
    inbox_leans_on: wp.array3d(dtype=wp.uint64)  # (W, N, N)

    line_place: wp.array2d(dtype=wp.int32)  # (W, A) scratch, per bearing of a frame, see lines.py
    line_bearing: wp.array2d(dtype=vec3d)  # (W, A) body frame
    line_point: wp.array2d(dtype=vec3d)  # (W, A) m
    line_spread: wp.array2d(dtype=wp.float64)  # (W, A) m^2
    line_fits: wp.array2d(dtype=wp.int32)  # (W, A)
    line_own: wp.array2d(dtype=mat26d)  # (W, A) H of the vehicle's own error
    line_other: wp.array2d(dtype=mat26d)  # (W, A) H of the member's error
    line_noise: wp.array2d(dtype=wp.float64)  # (W, A) variance per axis
    line_distance: wp.array2d(dtype=wp.float64)  # (W, A) m
    line_residual: wp.array2d(dtype=vec2d)  # (W, A)
    column: wp.array2d(dtype=mat66d)  # (W, M) scratch: a column of blocks
    narrow: wp.array2d(dtype=mat62d)  # (W, M) scratch: P H^T
    dx: wp.array2d(dtype=vec6d)  # (W, M) scratch: the correction of the members
    last: wp.array2d(dtype=vec6d)  # (W, M) scratch: the correction where the lines were drawn
    before_rotation: wp.array2d(dtype=mat33d)  # (W, M) scratch: the belief before a correction
    before_position: wp.array2d(dtype=vec3d)  # (W, M)
    before_covariance: wp.array3d(dtype=mat66d)  # (W, M, M)


def _where(used: str, **rules: Rule) -> dict[str, Rule]:
    """Return rules that count where a field of the whole state says so."""
    return {name: rule._replace(used=f"observer_{used}") for name, rule in rules.items()}


def _others(rule: Rule) -> Rule:
    """Return the rule of what is kept of the other members, not of the vehicle itself."""
    return rule._replace(holds=lambda v, *rest: np.insert(rule.holds(v[:, :, 1:], *rest), 0, True, axis=2))


_LARGE = numbers(LARGEST**3)
_MESSAGE = {"rotation": ROTATION, "covariance": COVARIANCE, "odometry_rotation": ROTATION}

VALID: dict[str, Rule] = {
    "start_covariance": COVARIANCE,
    "odometry_rotation": ROTATION,
    "members": whole(1, int(MOST_MEMBERS)),
    "P": JOINT_COVARIANCE,
    "seen_tick": TICK,
    "report_tick": TICK,
    "anchor_rotation": ROTATION,
    "anchor_covariance": COVARIANCE,
    "anchor_odometry_rotation": ROTATION,
    "anchor_tick": TICK,
    "searching": FLAG,
    "hypotheses": whole(0, int(MOST_SUPPOSED)),
    "attempts": whole(0, 10**9),
    "bearings": whole(0, 10**9),
    "outbox_says": FLAG,
    "inbox_says": FLAG,
    "inbox_tick": TICK,
    **dict.fromkeys(("twists", "distrusted", "line_fits"), FLAG),
    "line_place": whole(-1, int(MOST_MEMBERS) - 1),
    **_where("members", R=ROTATION, vehicle=whole(0, "vehicles")),
    **_where("members", **{f"report_{name}": _others(rule) for name, rule in _MESSAGE.items()}),
    **_where("searching", prior_rotation=ROTATION, prior_covariance=COVARIANCE),
    **_where("hypotheses", bank_rotation=ROTATION, bank_covariance=COVARIANCE),
    **_where("outbox_says", **{f"outbox_{name}": rule for name, rule in _MESSAGE.items()}),
    **_where("inbox_says", **{f"inbox_{name}": rule for name, rule in _MESSAGE.items()}),
    **dict.fromkeys(("paid", "surprise", "line_spread", "line_noise", "column", "narrow", "before_covariance"), _LARGE),
}
"""What a saved state may hold; numbers that are not in it have to be finite."""

PER_MEMBER = ("vehicle", "R", "p", "P", "twists", "v", "w", "seen_tick", "distrusted", "agreed")
PER_HYPOTHESIS = ("bank_rotation", "bank_position", "bank_covariance", "paid", "surprise", "bearings")


def allocate_robust(model: Any, worlds: int, start_covariance: np.ndarray, device: str) -> Any:
    """Return the record for `worlds` worlds, with the covariances (N, 6, 6) of the initial estimates in it."""
    N = model.vehicles
    state = RobustState()
    for name, var in RobustState.vars.items():
        shape = _shape(name, worlds, N, model.agents, model.radio.slots)
        setattr(state, name, wp.zeros(shape, dtype=var.type.dtype, device=device))
    state.start_covariance.assign(np.broadcast_to(start_covariance, (worlds, N, 6, 6)).copy())
    return state


def _shape(name: str, worlds: int, vehicles: int, agents: int, slots: int) -> tuple[int, ...]:
    if name.startswith("line_"):
        return worlds, agents
    if name in ("column", "narrow", "dx", "last") or name.startswith("before_"):
        return (worlds, *(MOST_MEMBERS,) * (2 if name == "before_covariance" else 1))
    if name.startswith("outbox_"):
        return worlds, vehicles, slots
    if name.startswith("inbox_"):
        return worlds, vehicles, vehicles
    if name in PER_HYPOTHESIS:
        return worlds, vehicles, BANK_PLACES
    if name in PER_MEMBER or name.startswith("report_"):
        return (worlds, vehicles, *(MOST_MEMBERS,) * (2 if name == "P" else 1))
    return worlds, vehicles
