"""What every vehicle's observer remembers: small records, and one record of arrays of them.

Covariances are of left errors (theta, rho), rad and m; positions are in the map frame. Numbers are float64 in worlds of
any precision, because what a neighbour has learnt is a small difference of large inverses.
"""

from typing import Any

import numpy as np
import warp as wp

from coopenv.base.format import LARGEST
from coopenv.estimation.validity import are_covariances
from coopenv.observers.robust.constants import MAX_CORRELATIONS, MAX_HYPOTHESES, MAX_MEMBERS, MAX_OFFENCES, STEPS
from coopenv.world.state import (
    COVARIANCE,
    FLAG,
    LEAST_EIGENVALUE,
    ROTATION,
    TICK,
    Rule,
    array,
    extended,
    numbers,
    whole,
)
from coopenv.world.warp_internals import device_function

vec2d: Any = wp.vec2d
vec3d: Any = wp.vec3d
mat22d: Any = wp.mat22d
mat33d: Any = wp.mat33d
vec6d: Any = wp.types.vector(6, wp.float64)
mat26d: Any = wp.types.matrix((2, 6), wp.float64)
mat66d: Any = wp.types.matrix((6, 6), wp.float64)
mat66f: Any = wp.types.matrix((6, 6), wp.float32)


@wp.struct
class Pose:
    """Body to map; or an increment of odometry, from its end to its start."""

    R: mat33d
    p: vec3d


@wp.struct
class Estimate:
    """A pose and its covariance."""

    pose: Pose
    P: mat66d


@wp.struct
class Report:
    """A message: where its sender is, what the sender's odometry says, and from whom it has heard."""

    tick: wp.int32  # when it was sent; -1: never
    valid: wp.int32  # 0: empty, the sender does not know where it is
    pose: Pose  # of the marker
    P: mat66f  # at the marker
    odometry: Pose  # of the marker, by dead reckoning from the start, in a frame of its own
    depends_on: wp.uint64  # bits of the vehicles whose messages are in it
    news: wp.int32  # whether it tells of correlations, and counts


@wp.struct
class Member:
    """One vehicle in a belief."""

    vehicle: wp.int32
    pose: Pose
    has_twist: wp.int32
    v: vec3d  # m/s, body; of the odometry's errors: (scale, 0, 0)
    w: vec3d  # rad/s, body; of the odometry's errors: the gyro's bias
    dated_v: vec3d  # m/s, body: by which clocks that are off count, see correlated_fusion.py
    velocity_variance: wp.float64  # (m/s)^2 per axis, of v
    seen_tick: wp.int32  # when it was last in view
    report: Report  # its last one, at which it stands
    distrusted: wp.int32
    agreement_time: wp.float64  # s for which a distrusted sender has agreed
    considered: wp.int32  # whether it stands as it says, and bearings do not correct it
    untold: wp.int32  # whether it had been heard before it was met, and nobody has told how its error correlates


@wp.struct
class Drift:
    """A sum of steps, which forgets, see sender_monitor.py."""

    sum: vec3d  # m
    covariance: mat33d  # m^2


@wp.struct
class Word:
    """What a vehicle makes of what another one says of its place, see sender_monitor.py; along the axes of the map."""

    offset: vec3d  # 1/m: information on how far it is from where it says
    certainty: mat33d  # 1/m^2: the matrix of that information
    drift: Drift  # of where it says to be from where its odometry has led
    slow_drift: Drift  # the same over a longer time
    missed_share: wp.float64  # mean share of bearings to it that do not fit
    fitted_time: wp.float64  # s for which they have
    perjured: wp.int32  # whether it was believed no more because it had contradicted itself
    offences: wp.int32  # how often it has not been believed
    barred_until: wp.int32  # the tick from which on it may be believed again


@wp.struct
class Belief:
    """What a vehicle believes, but for the members' poses and covariance."""

    odometry: Pose  # by dead reckoning, in a frame of its own
    has_sample: wp.int32  # whether there has been a tick
    sample_v: vec3d  # m/s, body: the odometry sample held at the last tick's end
    sample_w: vec3d  # rad/s, body
    mean_v: vec3d  # m/s, body: of the samples of late, see propagation.py
    members: wp.int32  # how many
    others: wp.int32  # the first of them that is another vehicle; before it the odometry's errors and the mounting
    depends_on: wp.uint64  # bits of vehicles
    missed_share: wp.float64  # mean share of bearings that do not fit
    healthy_time: wp.float64  # s for which it has been low
    accused: wp.int32  # the member that this frame's bearings contradict, 0: none
    accused_error: wp.float64  # m, by which it is off
    accused_followed: wp.int32  # whether the own pose has followed that error
    told_interval: wp.int32  # of `NEWS_TIME`, the last with a report that counts, from 1 on


@wp.struct
class Anchor:
    """Where a vehicle was when its bearings last fitted, or at the start."""

    estimate: Estimate
    odometry: Pose  # then
    tick: wp.int32


@wp.struct
class Search:
    """A search for the pose."""

    active: wp.int32
    prior: Estimate  # carried on by odometry
    hypotheses: wp.int32  # how many
    followed_time: wp.float64  # s for which hypotheses have been followed
    least_time: wp.float64  # s for which they have to be before one is believed
    waited_time: wp.float64  # s for which there were none
    clear_time: wp.float64  # s for which the frames' solutions have been well determined; below 0: s to the next look
    attempts: wp.int32


@wp.struct
class Hypothesis:
    """A pose that may be the vehicle's."""

    estimate: Estimate
    cost: wp.float64  # sum of normalised innovations squared, each limited, by the noise common to all hypotheses
    prior_distance: wp.float64  # squared, in standard deviations
    misfit: wp.float64  # sum of what bearings cost by its own noise, less twice what is expected of a true one


@wp.struct
class Frame:
    """What the bearings of a frame have in common; small, because functions are handed copies of their arguments."""

    lines: wp.int32  # how many bearings can be used
    mounting: wp.int32  # the member that stands for the camera's mounting, 0 if there is none or it counts as noise
    lever: vec3d  # m, of the camera in the body
    variance: wp.float64  # rad^2, of a bearing per tangent axis
    period: wp.float64  # s, since the last frame


@wp.struct
class Line:
    """A bearing of the frame as a measurement; scratch, see measurements.py."""

    member: wp.int32  # that it is to; 0: to a point in the map
    teller: wp.int32  # the member who has told that point, see solution_separation.py
    mounting: wp.int32  # see `Frame`
    bearing: vec3d  # body frame
    point: vec3d  # m, in the member's body or in the map
    variance: wp.float64  # m^2, of the point per axis
    fits: wp.int32
    jacobian: mat26d  # H of the vehicle's own error
    member_jacobian: mat26d  # H of the member's error
    mounting_jacobian: mat26d  # H of that of the mounting
    noise: wp.float64  # rad^2 per axis
    common_noise: wp.float64  # rad^2, the largest for any hypothesis
    distance: wp.float64  # m
    residual: vec2d  # rad
    weight: mat22d  # 1/rad^2, inverse of the innovation's covariance


@wp.struct
class Scratch:
    """What a correction needs of a member."""

    column: mat66d  # a block of the covariance
    row: mat66d  # another one, as it will be
    correction: vec6d
    full_correction: vec6d  # the correction of a member that is considered, which is not carried out
    last_correction: vec6d  # where the lines were linearised
    recentring: mat66d  # of errors about where they were linearised, then about where the member is put
    pose: Pose  # before the correction


@wp.struct
class CommonMemory:
    """What `robust` and `robust_joint` have in common.

    K members of a belief (the vehicle itself first), H hypotheses; other axes as in `coopenv.world.state`.
    """

    belief: array("WN", Belief)
    member: array("WNK", Member)
    P: array("WNKK", mat66d)  # blocks of the members' joint covariance
    anchor: array("WN", Anchor)
    search: array("WN", Search)
    word: array("WNN", Word)  # per receiver and sender
    hypothesis: array("WNH", Hypothesis)
    outbox: array("WNS", Report)
    inbox: array("WNN", Report)  # per receiver and sender
    line: array("WA", Line)
    scratch: array("WK", Scratch)
    gain: array("WAK", mat26d)  # scratch: of a line in a member, transposed and not yet weighted, see correction.py


ERRORS = 1  # the member that stands for the odometry's errors, where there is one, see propagation.py
MOUNTING = 2  # the member that stands for the error of the camera's mounting, where there is one, see propagation.py
SIZES = {"K": MAX_MEMBERS + MOUNTING, "H": MAX_HYPOTHESES + 1}  # besides the hypotheses of one frame there is the prior


@device_function
def clear(model: Any, memory: Any, world: int, i: int):
    """Forget an earlier episode, down to what is only used within a tick: equal states are equal in every bit."""
    memory.belief[world, i] = Belief()
    memory.search[world, i] = Search()
    members = memory.member.shape[2]
    for n in range(members):
        memory.member[world, i, n] = Member()
        memory.scratch[world, n] = Scratch()
        for k in range(members):
            memory.P[world, i, n, k] = mat66d()
    for h in range(memory.hypothesis.shape[2]):
        memory.hypothesis[world, i, h] = Hypothesis()
    for sender in range(model.vehicles):
        memory.word[world, i, sender] = Word()
    for n in range(model.agents):
        memory.line[world, n] = Line()
        for k in range(members):
            memory.gain[world, n, k] = mat26d()


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
    """Return what a saved memory with so many members may hold, by field, see `coopenv.world.state`."""
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


@wp.struct
class Correlation:
    """What a sender tells of its error and that of a vehicle that it hears, see correlations.py."""

    vehicle: wp.int32  # -1: none
    tick: wp.int32  # when the report was sent that the sender has from that vehicle
    matrix: mat66f  # whole numbers, in steps


@wp.struct
class Known:
    """The covariance of a sender's new error with that of a member; scratch, see correlations.py."""

    member: wp.int32
    covariance: mat66d
    coefficient: mat66d


@wp.struct
class Alone:
    """Where landmarks and odometry alone put a vehicle, see solution_separation.py."""

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
