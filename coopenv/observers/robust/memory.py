"""The state of every vehicle's observer: small records, one record of arrays of them, and rules for saved states.

Covariances are of left errors (theta, rho), rad and m; positions are in the map frame. Numbers are float64 in worlds of
any precision, because the covariance of a sender's increment is a small difference of two large ones.
"""

from typing import Any

import numpy as np
import warp as wp

from coopenv.base.sections import LARGEST
from coopenv.estimation.validity import are_covariances
from coopenv.observers.robust.algebra import (
    Pose,
    PoseEstimate,
    mat22d,
    mat23d,
    mat26d,
    mat33d,
    mat63d,
    mat66d,
    mat66f,
    vec2d,
    vec3d,
    vec6d,
)
from coopenv.observers.robust.constants import MAX_CORRELATIONS, MAX_HYPOTHESES, MAX_MEMBERS, STEPS
from coopenv.world.embedded import Nothing
from coopenv.world.state import COVARIANCE, FLAG, LEAST_EIGENVALUE, ROTATION, TICK, Rule, array, numbers, whole
from coopenv.world.warp_internals import device_function


@wp.struct
class SenderReport:
    """A message: pose of the sender, its dead reckoning, and the vehicles whose messages it has fused."""

    tick: wp.int32  # when it was sent; -1: never
    valid: wp.int32  # 0: empty, the sender is searching for its pose
    pose: Pose  # of the marker
    P: mat66f  # at the marker
    odometry: Pose  # of the marker, by dead reckoning from the start, in a frame of its own
    depends_on: wp.uint64  # bits of the vehicles whose messages are in it
    carries_correlations: wp.int32  # 1: the report has correlations and is fused


@wp.struct
class Member:
    """One vehicle of a joint state."""

    vehicle: wp.int32
    box: wp.int32  # of its messages at this tick, see `coopenv.world.nearby`
    pose: Pose
    has_twist: wp.int32
    v: vec3d  # m/s, body; of the errors of odometry and frames: (scale, relative focal length, latency in s)
    w: vec3d  # rad/s, body; of the odometry's errors: the gyro's bias
    clock_v: vec3d  # m/s, body: velocity at which clock offsets count, see correlated_fusion.py
    velocity_variance: wp.float64  # (m/s)^2 per axis, of v
    seen_tick: wp.int32  # when it was last in view
    report: SenderReport  # its last one, at which it stands
    source: wp.int32  # the slot of a sender's monitor, see integrity.py
    correlation_unknown: wp.int32  # 1: an earlier source of information with an unknown correlation


@wp.struct
class BlockSums:
    """Sums over the present blocks of the guard, by length of a block and row of a bearing, see guard.py."""

    innovation: mat22d  # over standard deviations
    white: mat22d  # shares of the bearings' noise in the variances
    lasting: mat22d  # roots of the other shares, if these are a sender's


@wp.struct
class GuardTotals:
    """Decaying totals of the guard by length of a block, see guard.py."""

    time: vec2d  # s since the present block began
    squared: vec2d  # sums over their variances
    expected: vec2d
    freedom: vec2d  # degrees of freedom
    factor: wp.float64  # on the covariance that is stated and broadcast; 0: none yet


@wp.struct
class SourceMonitor:
    """A source of information and the monitor of its fault f, see integrity.py."""

    target: wp.int32  # a landmark, or the number of landmarks plus a vehicle; -1: none
    seen_tick: wp.int32  # when it was last in view
    excluded: wp.int32
    exclusions: wp.int32  # how many so far
    vector: vec3d  # a, of the present block
    sum: vec3d  # v, of the blocks of late
    information: mat33d  # V, likewise
    map_variance: wp.float64  # m^2 per axis, of a landmark's place on the map, as declared
    rejected: wp.float64  # mean share of its bearings that fail the gate
    fitted_time: wp.float64  # s for which its bearings have passed it
    ratio: wp.float64  # twice the logarithm of the likelihood ratio of its fault to none
    offset: vec3d  # f: its most likely fault, of an excluded one when it was excluded
    covariance: mat33d  # of that fault
    drift: vec3d  # m, sum of a sender's increments since `drift_ratio` was last small; does not decay
    drift_vector: vec3d  # their decaying sum, weighted by the inverse of the covariance that each has without a fault
    drift_information: mat33d  # the decaying sum of these weights
    drift_ratio: wp.float64  # like `ratio`, of a drift of the sender
    drift_time: wp.float64  # s for which it has been likely
    time: wp.float64  # s for which bearings to it have fitted while excluded; of the velocity, since its last fault
    walk: wp.float64  # variance that the odometry's scale gains in a second, because the velocity's fault has returned
    guard: BlockSums


@wp.struct
class JointBelief:
    """The joint state of a vehicle's estimator, without the members' poses and covariance."""

    odometry: Pose  # by dead reckoning, in a frame of its own
    map_errors: wp.int32  # whether the map has any error
    has_sample: wp.int32  # whether there has been a tick
    sample_v: vec3d  # m/s, body: the odometry sample held at the last tick's end
    sample_w: vec3d  # rad/s, body
    mean_v: vec3d  # m/s, body: of the samples of late, see joint_state.py
    mean_w: vec3d  # rad/s, body, likewise
    members: wp.int32  # how many
    first_sender: wp.int32  # the first of them that is another vehicle; before it the calibration states
    depends_on: wp.uint64  # bits of vehicles
    rejected_share: wp.float64  # mean share of bearings that fail the gate
    rejected_sources: wp.uint64  # bits of the slots of which any has failed since that share was last low
    healthy_time: wp.float64  # s for which it has been low
    lost_time: wp.float64  # s for which most bearings have failed the gate
    counted_tick: wp.int32  # of the last frame with bearings that count
    block_time: wp.float64  # s since the monitors' present block began
    news_interval: wp.int32  # of `NEWS_TIME`, the last with a report that carries correlations, from 1 on
    guard: GuardTotals


@wp.struct
class Anchor:
    """The pose at which the bearings last fitted, or the initial one: the prior of a search."""

    estimate: PoseEstimate
    odometry: Pose  # then
    tick: wp.int32


@wp.struct
class Search:
    """A search for the pose."""

    active: wp.int32
    prior: PoseEstimate  # the tracked estimate, while the belief's arrays serve one hypothesis after the other
    hypotheses: wp.int32  # how many
    tracked_time: wp.float64  # s for which hypotheses have been tracked
    least_time: wp.float64  # s for which they have to be tracked before one is accepted
    waited_time: wp.float64  # s for which there were none
    determined_time: wp.float64  # s for which all solutions have been well determined; below 0: s to the next attempt
    attempts: wp.int32


@wp.struct
class Hypothesis:
    """A candidate for the vehicle's pose, with a filter of its own."""

    estimate: PoseEstimate
    cost: wp.float64  # sum of normalised innovations squared, each limited, by the noise common to all hypotheses
    prior_distance: wp.float64  # squared, in standard deviations
    misfit: wp.float64  # sum of innovations squared by its own noise, less twice the value expected of the true one


@wp.struct
class BearingFrame:
    """Properties that all bearings of a frame share; small, because functions receive copies of their arguments."""

    searching: wp.int32  # 1: its bearings are those of hypotheses
    tick: wp.int32
    bearings: wp.int32  # how many bearings can be used
    mounting: wp.int32  # the member that stands for the camera's mounting, 0 if there is none or it counts as noise
    errors: wp.int32  # the member with the errors of focal length and latency, likewise
    axis: vec3d  # optical, unit vector in the body
    lever: vec3d  # m, of the camera in the body
    variance: wp.float64  # rad^2, of a bearing per tangent axis
    period: wp.float64  # s, since the last frame
    age: wp.float64  # s, since its exposure
    since: Pose  # the vehicle's motion from now back to the exposure
    jitter: wp.float64  # s^2, variance of the age that is new in every frame


@wp.struct
class BearingMeasurement:
    """A bearing of the frame as a measurement; scratch, see measurements.py."""

    member: wp.int32  # its target; 0: a point in the map
    source: wp.int32  # the slot of its monitor, -1: none
    is_reading: wp.int32  # 0: a bearing of the camera, 1: of another sensor
    rows: wp.int32  # how many of its two rows were measured
    bearing: vec3d  # body frame
    point: vec3d  # m, in the member's body or in the map
    variance: wp.float64  # m^2, of the point per axis
    by_map: mat23d  # its derivative by the error of the point on the map, rad/m
    fits: wp.int32  # 1: used, -1: only by the monitors, 0: not
    noise: wp.float64  # rad^2 per axis
    common_noise: wp.float64  # rad^2, the largest for any hypothesis
    distance: wp.float64  # m
    residual: vec2d  # rad
    innovation: vec2d  # rad, less the correction by earlier bearings
    weight: mat22d  # 1/rad^2, inverse of the innovation's covariance


@wp.struct
class FusedReading:
    """The rest of a measurement of a sensor beside the camera, two of its rows at most; scratch, see readings.py."""

    part: wp.int32  # which pair of its rows, from 0 on
    kind: wp.int32  # its place in the table of kinds
    rotation: mat33d  # sensor to body
    place: vec3d  # m, of the sensor in the body
    value: vec6d
    std: vec6d  # of the rows
    turn: mat33d  # orientation of the target, on the map or in the member's body
    turn_known: wp.int32  # 0: that of a landmark that moves is not known
    turn_variance: wp.float64  # rad^2 per axis, of that
    period: wp.float64  # s, since the sensor's last measurements


@wp.struct
class Derivative:
    """The derivative of a measurement by the error of a member."""

    member: wp.int32  # -1: none
    jacobian: mat26d


@wp.struct
class Scratch:
    """Intermediate results of a correction for one member."""

    column: mat66d  # a block of the covariance
    row: mat66d  # another one, as it will be
    correction: vec6d
    last_correction: vec6d  # at which the measurements were linearised
    recentring: mat66d  # of errors about where they were linearised, then about where the member is put
    pose: Pose  # before the correction


@wp.struct
class Correlation:
    """The correlation of a sender's error with the error of a vehicle that it receives, see correlations.py."""

    vehicle: wp.int32  # -1: none
    tick: wp.int32  # at which that vehicle sent the report on which the correlation is based
    matrix: mat66f  # whole numbers, in steps


@wp.struct
class Regressor:
    """The covariance of a sender's new error with that of a member; scratch, see correlations.py."""

    member: wp.int32
    covariance: mat66d
    coefficient: mat66d


def memory_struct(entries: str, of_reading: Any, name: str = "RobustMemory") -> Any:
    """Return the Warp struct of the memory.

    Functions that differ for worlds with sensors beside the camera are overloads for both structs (readings.py).

    Args:
        entries: the axis of a frame's measurements, F; or X where all of them are bearings of the camera.
        of_reading: the struct of what a measurement of another sensor has beside; `Nothing` without any.
        name: of the struct: structs with the same fields differ by it.
    """

    class RobustMemory:
        """The memory of a world's observers.

        K members of a belief (the vehicle itself first), H hypotheses, J errors that a measurement depends on, C
        correlations of a message, Q sources; other axes as in `coopenv.world.state`. Arrays with lanes (L) are scratch.
        """

        belief: array("WN", JointBelief)
        member: array("WNK", Member)
        P: array("WNKK", mat66d)  # blocks of the members' joint covariance
        anchor: array("WN", Anchor)
        search: array("WN", Search)
        source: array("WNQ", SourceMonitor)
        sensitivity: array("WNQO", mat63d)  # of the own error and the calibration errors by the fault of a source
        information: array("WNQU", mat33d)  # on a fault; and on it and that of a sender, by slot
        fault_mixture: array("WN", mat66d)  # addition of uncertain faults to the covariance of the own pose
        effect: array("WL" + entries + "Q", mat23d)  # of an innovation by the fault of a source
        weighted_effect: array("WL" + entries + "Q", mat23d)  # times the weight of the bearing
        block_scratch: array("WLKK", mat33d)  # blocks of the covariance of senders' errors or faults
        block_member: array("WLK", wp.int32)  # the members to which they belong
        hypothesis: array("WNH", Hypothesis)
        outbox: array("WNS", SenderReport)
        inbox: array("WNY", SenderReport)  # per receiver and box
        inbox_sender: array("WNY", wp.int32)  # sender of that report, where not all are kept; -1: none
        measurement: array("WL" + entries, BearingMeasurement)
        derivative: array(
            "WL" + entries + "J", Derivative
        )  # of a bearing: by the errors of oneself, target, mounting, focal length and latency
        scratch: array("WLK", Scratch)
        projection: array("WL" + entries + "K", mat26d)  # H P, of a bearing and a member, see correction.py
        outbox_correlation: array("WNSC", Correlation)
        correlation: array("WNYC", Correlation)  # per receiver and box
        map_projection: array("WL" + entries + "D", mat23d)  # covariance of a bearing with the errors of landmarks
        known: array("WLK", Regressor)
        reading: array("WL" + entries, of_reading)  # of measurements of sensors beside the camera, see readings.py
        reading_tick: array("WNR", wp.int32)  # of the last frame with measurements of a sensor; -1: none
        factor: array("WLKK", mat66d)  # blocks of a Cholesky factor, on its diagonal their inverses

    RobustMemory.__qualname__ = name
    return wp.struct(RobustMemory)


RobustMemory, RobustMemoryWithReadings = memory_struct("X", Nothing), memory_struct("F", FusedReading)


ERRORS = 1  # the member that stands for the errors of odometry and frames, see joint_state.py
FOCAL_ERROR, LATENCY_ERROR = 4, 5  # those of the focal length and of the latency among these errors
MOUNTING = 2  # the member that stands for the error of the camera's mounting, where there is one, see joint_state.py
DERIVATIVES = 4  # the most errors that a bearing depends on
SENDER_SLOTS, LANDMARK_SLOTS = MAX_MEMBERS - 1, 4
SOURCES = 5 + SENDER_SLOTS + LANDMARK_SLOTS
ROBUST_SIZES = {
    "K": MAX_MEMBERS + MOUNTING,
    "H": MAX_HYPOTHESES + 1,
    "J": DERIVATIVES,
    "C": MAX_CORRELATIONS,
    "Q": SOURCES,
    "D": LANDMARK_SLOTS,
    "U": 1 + SENDER_SLOTS,
    "O": 1 + MOUNTING,
}
"""Besides the hypotheses of one frame there is the prior."""


@wp.func
def fill(row: Any, value: Any):
    """Set all entries of an array."""
    for n in range(row.shape[0]):
        row[n] = value


@wp.func
def fill_rows(rows: Any, value: Any):
    """Set all entries of an array with two axes."""
    for n in range(rows.shape[0]):
        fill(rows[n], value)


@device_function
def clear(memory: Any, world: int, i: int):
    """Clear an earlier episode, messages included: equal states are equal in every bit."""
    memory.belief[world, i] = JointBelief()
    memory.search[world, i] = Search()
    fill(memory.member[world, i], Member())
    fill_rows(memory.P[world, i], mat66d())
    fill(memory.hypothesis[world, i], Hypothesis())
    fill(memory.outbox[world, i], SenderReport())
    never = SenderReport()
    never.tick = -1
    fill(memory.inbox[world, i], never)
    fill(memory.inbox_sender[world, i], -1)
    fill(memory.reading_tick[world, i], -1)


LARGE = numbers(LARGEST**3)


def are_joint(blocks: Any, count: Any) -> Any:
    """Return flags (...): blocks (..., K, K, 6, 6) are covariances, as far as they count (...)."""
    K = blocks.shape[-3]
    used = np.repeat(np.arange(K) < count[..., None], 6, axis=-1)
    P = np.swapaxes(blocks, -3, -2).reshape(*count.shape, 6 * K, 6 * K)
    joint = np.where(used[..., :, None] & used[..., None, :], P, np.eye(6 * K))
    return are_covariances(joint, LEAST_EIGENVALUE[blocks.dtype])


def where(used: str, rules: dict[str, Rule]) -> dict[str, Rule]:
    """Return rules that apply where a field of the memory is not 0."""
    return {name: rule._replace(used=f"observer_{used}") for name, rule in rules.items()}


def _of_senders(rule: Rule) -> Rule:
    """Return a rule that applies to members that are other vehicles."""

    def holds(values: Any, fields: Any, model: Any) -> Any:
        mask = np.asarray(rule.holds(values, fields, model))
        of_own = np.arange(values.shape[2]) < fields["observer_belief.first_sender"][..., None]
        return mask | of_own.reshape(*of_own.shape, *(1,) * (mask.ndim - of_own.ndim))

    return rule._replace(holds=holds)


VEHICLE = Rule("a vehicle or -1", lambda values, fields, model: (values >= -1) & (values < model.vehicles))
BOX = Rule("a box", lambda values, fields, model: (values >= 0) & (values <= (model.kept or model.vehicles - 1)))
WITHIN = Rule("within its steps", lambda values, fields, model: abs(values) <= STEPS)


def robust_rules() -> dict[str, Rule]:
    """Return the rules of a saved memory by field, see `coopenv.world.state`."""
    members = ROBUST_SIZES["K"]
    flags = (
        "search.active outbox.valid inbox.valid belief.has_sample belief.map_errors member.has_twist "
        "source.excluded member.correlation_unknown member.report.valid outbox.carries_correlations "
        "inbox.carries_correlations member.report.carries_correlations"
    )
    ticks = (
        "member.seen_tick member.report.tick anchor.tick outbox.tick inbox.tick source.seen_tick belief.counted_tick "
        "reading_tick"
    )
    large = (
        "hypothesis.cost hypothesis.misfit hypothesis.prior_distance fault_mixture sensitivity information "
        "source.drift source.drift_vector source.drift_information source.drift_ratio source.drift_time "
        "source.walk source.vector source.ratio source.sum source.information source.covariance source.offset "
        "source.guard.innovation source.guard.white source.guard.lasting belief.guard.time belief.guard.squared "
        "belief.guard.expected belief.guard.freedom belief.guard.factor"
    )
    rules = {
        **dict.fromkeys(flags.split(), FLAG),
        **dict.fromkeys(ticks.split(), TICK),
        **dict.fromkeys(large.split(), LARGE),
        **dict.fromkeys(("belief.odometry.R", "anchor.estimate.pose.R", "anchor.odometry.R"), ROTATION),
        **dict.fromkeys(("search.attempts", "belief.news_interval"), whole(0, 10**9)),
        "source.target": whole(-1, "agents"),
        "source.exclusions": whole(0, 10**9),
        "inbox_sender": VEHICLE,
        "belief.members": whole(1, members),
        "belief.first_sender": whole(1, MOUNTING + 1),
        "P": Rule("a covariance", lambda P, fields, model: are_joint(P, fields["observer_belief.members"]), axes=4),
        "anchor.estimate.P": COVARIANCE,
        "search.hypotheses": whole(0, MAX_HYPOTHESES),
        **where(
            "belief.members", {"member.pose.R": ROTATION, "member.vehicle": whole(0, "vehicles"), "member.box": BOX}
        ),
        **where("belief.members", {"member.source": _of_senders(whole(1, SENDER_SLOTS))}),
        **where("search.hypotheses", {"hypothesis.estimate.pose.R": ROTATION, "hypothesis.estimate.P": COVARIANCE}),
    }
    reports = {"pose.R": ROTATION, "P": COVARIANCE, "odometry.R": ROTATION}
    for box in ("outbox", "inbox"):
        rules |= where(f"{box}.valid", {f"{box}.{name}": rule for name, rule in reports.items()})
    rules |= where("belief.members", {f"member.report.{name}": _of_senders(rule) for name, rule in reports.items()})
    for box in ("outbox_correlation", "correlation"):
        rules |= {f"{box}.vehicle": VEHICLE, f"{box}.tick": TICK, f"{box}.matrix": WITHIN}
    return rules
