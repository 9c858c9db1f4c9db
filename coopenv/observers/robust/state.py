"""What every vehicle's observer remembers: one record of arrays with leading axes (world, vehicle)."""

import numpy as np
import warp as wp

from coopenv.observers.robust.reference.observer import Robust
from coopenv.observers.robust.reference.search import MOST_HYPOTHESES
from coopenv.observers.robust.types import mat26d, mat33d, mat62d, mat66d, mat66f, vec2d, vec3d, vec6d
from coopenv.scenario.base import LARGEST
from coopenv.world.records import array
from coopenv.world.saved_state import COVARIANCE, FLAG, JOINT_COVARIANCE, ROTATION, TICK, Rule, numbers, whole

MOST_SUPPOSED = wp.constant(MOST_HYPOTHESES)
"""Hypotheses that one frame gives, or that are followed."""
SPARE_PLACE = wp.constant(MOST_HYPOTHESES + 1)
BANK_PLACES = wp.constant(MOST_HYPOTHESES + 2)
"""What one frame gives, the prior, and a spare place."""
SIZES = {"K": Robust.most_members, "H": MOST_HYPOTHESES + 2}


@wp.struct
class RobustState:
    """K members of a belief (the vehicle itself first), H hypotheses; other axes as in `coopenv.world.state`.

    Left errors (theta, rho) in rad and m; positions in the map frame; float64 in worlds of any precision.
    """

    odometry_rotation: array("WN", mat33d)  # pose by dead reckoning, in a frame of its own
    odometry_position: array("WN", vec3d)

    members: array("WN", wp.int32)  # how many are in the belief
    vehicle: array("WNK", wp.int32)
    R: array("WNK", mat33d)
    p: array("WNK", vec3d)
    P: array("WNKK", mat66d)  # blocks of the joint covariance
    twists: array("WNK", wp.int32)  # whether a twist is known
    v: array("WNK", vec3d)  # m/s, body
    w: array("WNK", vec3d)  # rad/s, body
    seen_tick: array("WNK", wp.int32)  # when a member was last in view
    report_tick: array("WNK", wp.int32)  # last report of a member: when it was sent
    report_rotation: array("WNK", mat33d)
    report_position: array("WNK", vec3d)
    report_covariance: array("WNK", mat66d)
    report_odometry_rotation: array("WNK", mat33d)
    report_odometry_position: array("WNK", vec3d)
    report_leans_on: array("WNK", wp.uint64)
    distrusted: array("WNK", wp.int32)
    agreed: array("WNK", wp.float64)  # s since which a distrusted sender has agreed
    leans_on: array("WN", wp.uint64)  # bits of vehicles
    missed: array("WN", wp.float64)  # mean share of bearings that do not fit
    healthy: array("WN", wp.float64)  # s since which it has been low
    anchor_rotation: array("WN", mat33d)  # where the vehicle was then
    anchor_position: array("WN", vec3d)
    anchor_covariance: array("WN", mat66d)
    anchor_odometry_rotation: array("WN", mat33d)
    anchor_odometry_position: array("WN", vec3d)
    anchor_tick: array("WN", wp.int32)

    searching: array("WN", wp.int32)
    prior_rotation: array("WN", mat33d)
    prior_position: array("WN", vec3d)
    prior_covariance: array("WN", mat66d)
    hypotheses: array("WN", wp.int32)  # how many
    bank_rotation: array("WNH", mat33d)
    bank_position: array("WNH", vec3d)
    bank_covariance: array("WNH", mat66d)
    paid: array("WNH", wp.float64)
    surprise: array("WNH", wp.float64)  # squared distance from the prior
    bearings: array("WNH", wp.int32)  # for which it has paid
    age: array("WN", wp.float64)  # s, for which hypotheses have been followed
    waited: array("WN", wp.float64)  # s, for which there were none
    clear: array("WN", wp.float64)  # s, for which the last frames' solutions have been well determined
    attempts: array("WN", wp.int32)

    outbox_says: array("WNS", wp.int32)  # 0: an empty message
    outbox_rotation: array("WNS", mat33d)
    outbox_position: array("WNS", vec3d)  # of the marker
    outbox_covariance: array("WNS", mat66f)
    outbox_odometry_rotation: array("WNS", mat33d)
    outbox_odometry_position: array("WNS", vec3d)  # of the marker
    outbox_leans_on: array("WNS", wp.uint64)
    inbox_tick: array("WNN", wp.int32)  # of sending; -1: never heard
    inbox_says: array("WNN", wp.int32)
    inbox_rotation: array("WNN", mat33d)
    inbox_position: array("WNN", vec3d)
    inbox_covariance: array("WNN", mat66f)
    inbox_odometry_rotation: array("WNN", mat33d)
    inbox_odometry_position: array("WNN", vec3d)
    inbox_leans_on: array("WNN", wp.uint64)

    line_place: array("WA", wp.int32)  # scratch, per bearing of a frame, see lines.py
    line_bearing: array("WA", vec3d)  # body frame
    line_point: array("WA", vec3d)  # m
    line_spread: array("WA", wp.float64)  # m^2
    line_fits: array("WA", wp.int32)
    line_own: array("WA", mat26d)  # H of the vehicle's own error
    line_other: array("WA", mat26d)  # H of the member's error
    line_noise: array("WA", wp.float64)  # variance per axis
    line_distance: array("WA", wp.float64)  # m
    line_residual: array("WA", vec2d)
    column: array("WK", mat66d)  # scratch: a column of blocks
    narrow: array("WK", mat62d)  # scratch: P H^T
    dx: array("WK", vec6d)  # scratch: the correction of the members
    last: array("WK", vec6d)  # scratch: the correction where the lines were drawn
    before_rotation: array("WK", mat33d)  # scratch: the belief before a correction
    before_position: array("WK", vec3d)
    before_covariance: array("WKK", mat66d)


def _where(used: str, **rules: Rule) -> dict[str, Rule]:
    """Return rules that count where a field of the whole state says so."""
    return {name: rule._replace(used=f"observer_{used}") for name, rule in rules.items()}


def _others(rule: Rule) -> Rule:
    """Return the rule of what is kept of the other members, not of the vehicle itself."""
    return rule._replace(holds=lambda v, *rest: np.insert(rule.holds(v[:, :, 1:], *rest), 0, True, axis=2))


_LARGE = numbers(LARGEST**3)
_MESSAGE = {"rotation": ROTATION, "covariance": COVARIANCE, "odometry_rotation": ROTATION}

VALID: dict[str, Rule] = {
    "odometry_rotation": ROTATION,
    "members": whole(1, Robust.most_members),
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
    "line_place": whole(-1, Robust.most_members - 1),
    **_where("members", R=ROTATION, vehicle=whole(0, "vehicles")),
    **_where("members", **{f"report_{name}": _others(rule) for name, rule in _MESSAGE.items()}),
    **_where("searching", prior_rotation=ROTATION, prior_covariance=COVARIANCE),
    **_where("hypotheses", bank_rotation=ROTATION, bank_covariance=COVARIANCE),
    **_where("outbox_says", **{f"outbox_{name}": rule for name, rule in _MESSAGE.items()}),
    **_where("inbox_says", **{f"inbox_{name}": rule for name, rule in _MESSAGE.items()}),
    **dict.fromkeys(("paid", "surprise", "line_spread", "line_noise", "column", "narrow", "before_covariance"), _LARGE),
}
"""What a saved state may hold; numbers that are not in it have to be finite."""
