"""One tick of one vehicle's observer, its start, and the observer as a plug-in.

A vehicle estimates a joint state of itself and of the vehicles that it receives. Bearings to landmarks and to vehicles
correct it. A neighbour's message adds the information that is new since its last message. So no information counts
twice, and the neighbour's slowly varying error does not count as white noise. If most bearings fail the gate, to more
than one target, all of them count for a while. If that does not help, the estimate restarts with a larger covariance,
and hypotheses of a search compete with it, as with an uncertain initial estimate. During a search the vehicle
broadcasts nothing.
"""

from dataclasses import replace
from functools import cache
from typing import Any

import warp as wp

from coopenv.base.errors import CoopenvError
from coopenv.estimation.linalg import orthonormalise, sheared, skew, symmetric_part
from coopenv.estimation.poses import Coordinates
from coopenv.measurements.sensor import functions_of
from coopenv.measurements.table import KINDS
from coopenv.observers.contract import Observer, Setup
from coopenv.observers.kernel_observer import KernelObserver
from coopenv.observers.robust import constants
from coopenv.observers.robust.algebra import (
    Pose,
    PoseEstimate,
    between,
    carried,
    distance_squared,
    inflated,
    inverse_factor,
    is_known,
    is_vague,
    mat33d,
    odometry_noise,
    vec2d,
    vec3d,
    with_noise,
)
from coopenv.observers.robust.correction import gate_is_open, iterated_update
from coopenv.observers.robust.correlated_fusion import fuse_messages
from coopenv.observers.robust.correlations import clear_broadcasts, receive_broadcast, send_broadcast
from coopenv.observers.robust.fault_hypotheses import detect_and_exclude, test_excluded
from coopenv.observers.robust.guard import guard_covariance
from coopenv.observers.robust.integrity import correct_sources, protection_level
from coopenv.observers.robust.joint_state import (
    begin_belief,
    begin_errors,
    increment_noise,
    own_estimate,
    propagate_own,
    set_anchor,
    take_odometry,
    walk_errors,
)
from coopenv.observers.robust.linearisation import innovation_squared
from coopenv.observers.robust.measurements import set_bearing_measurements
from coopenv.observers.robust.memory import (
    ROBUST_SIZES,
    BearingFrame,
    FusedReading,
    RobustMemory,
    RobustMemoryWithReadings,
    Search,
    clear,
    memory_struct,
    robust_rules,
)
from coopenv.observers.robust.messages import ROBUST_MESSAGES, bit_of
from coopenv.observers.robust.readings import add_readings, rows_in, rows_of_kind
from coopenv.observers.robust.search import advance_search, begin_search, propagate_search
from coopenv.observers.robust.sources import begin_monitors, begin_sources, guarded_covariance, is_excluded
from coopenv.world.embedded import Embedded
from coopenv.world.nearby import is_target
from coopenv.world.v2x import start_covariance
from coopenv.world.warp_internals import device_function, subroutine

ANCHOR_ANGLE_VARIANCE = (0.25 * constants.KNOWN_ANGLE) ** 2
ANCHOR_POSITION_VARIANCE = (0.25 * constants.KNOWN_POSITION) ** 2
"""Variances (rad^2 and m^2) added to the covariance of an anchor, which may be wrong at the time of the loss."""
INFLATION = constants.SQUARED_MARGIN**2  # of an anchor's covariance for the next restart


@subroutine
def gate(frame: BearingFrame, memory: Any, world: int, i: int):
    """Linearise the bearings and gate them; return the share of rejected ones, the rows of used ones, and their NIS.

    Bearings to excluded sources are not used and do not count in the share, nor do measurements without a target. The
    share is the larger one of the camera's bearings and of the other sensors' measurements, -1 if none counts: ranges
    may fit at a wrong heading.
    """
    counted = vec2d()
    missed = vec2d()
    rows = int(0)
    total = wp.float64(0.0)
    is_open = gate_is_open(memory, world, i)
    for n in range(frame.bearings):
        nis = innovation_squared(frame, memory, world, i, n)
        ahead = nis >= wp.float64(0.0) and nis < wp.float64(wp.inf)
        fits = ahead and nis < wp.float64(constants.BEARING_GATE)
        q = memory.measurement[world, i, n].source
        used = not is_excluded(memory, world, i, q)
        if used and memory.measurement[world, i, n].distance < wp.float64(wp.inf):
            kind = memory.measurement[world, i, n].is_reading
            counted[kind] = counted[kind] + wp.float64(1.0)
            if not fits:
                missed[kind] = missed[kind] + wp.float64(1.0)
                rejected = memory.belief[world, i].rejected_sources | bit_of(1 + q)
                memory.belief[world, i].rejected_sources = rejected
        elif fits and not used:
            test_excluded(frame, memory, world, i, n, q)
        memory.measurement[world, i, n].fits = 0
        if used and (fits or (is_open and ahead)):
            memory.measurement[world, i, n].fits = 1
            rows += memory.measurement[world, i, n].rows
            total += nis
        elif used and ahead:  # for the monitors
            memory.measurement[world, i, n].fits = -1
    share = wp.float64(-1.0)
    for kind in range(2):
        if counted[kind] > wp.float64(0.0):
            share = wp.max(share, missed[kind] / counted[kind])
    return share, rows, total


@wp.func
def is_valid(estimate: PoseEstimate):
    """Return whether an estimate is finite and its covariance positive definite, but for rounding."""
    factor = inverse_factor(inflated(estimate.P, wp.float64(constants.ROUNDING)))
    return wp.isfinite(wp.trace(factor) + wp.length(estimate.pose.p) + wp.trace(estimate.pose.R))


@subroutine
def declare_lost(model: Any, memory: Any, world: int, i: int, tick: int):
    """Restart from the anchor, propagated by odometry, with a larger covariance after each failure; begin a search."""
    anchor = memory.anchor[world, i]
    elapsed = wp.float64(tick - anchor.tick) * model.camera_period
    step = between(anchor.odometry, memory.belief[world, i].odometry)
    begin_errors(model, memory, world, i)  # their estimates may be wrong, too
    noise = increment_noise(model, memory, world, i, step, elapsed, elapsed)
    restart_belief(model, memory, world, i, carried(anchor.estimate, step, noise))
    P = wp.float64(INFLATION) * anchor.estimate.P
    if not is_vague(P):
        memory.anchor[world, i].estimate.P = P
    if memory.search[world, i].active == 0:
        begin_search(memory, world, i)


@device_function
def confirm(memory: Any, world: int, i: int):
    """End a search by the tracked estimate; its monitors begin."""
    memory.search[world, i] = Search()
    begin_monitors(memory, world, i)


@device_function
def note_rejections(model: Any, memory: Any, world: int, i: int, share: Any, now: Any):
    """Open the gate if most bearings fail it, declare the vehicle lost if that lasts, and end a search if few do.

    A frame counts for the time since the last one with bearings, within `NEWS_TIME`. Most bearings fail if the own pose
    is wrong. If only one source's bearings fail, that source is as likely wrong.
    """
    since = wp.float64(now.tick - memory.belief[world, i].counted_tick) * model.camera_period
    memory.belief[world, i].counted_tick = now.tick
    period = wp.clamp(since, now.period, wp.max(now.period, wp.float64(constants.NEWS_TIME)))
    weight = wp.min(wp.float64(1.0), period / wp.float64(constants.MEAN_TIME))
    missed = memory.belief[world, i].rejected_share + (share - memory.belief[world, i].rejected_share) * weight
    memory.belief[world, i].rejected_share = missed
    several = wp.bit_count(memory.belief[world, i].rejected_sources) > wp.uint64(1)
    many = missed > wp.float64(constants.LOST_SHARE)
    if memory.belief[world, i].lost_time > wp.float64(0.0) or (many and several):
        memory.belief[world, i].lost_time += period
    healthy = memory.belief[world, i].healthy_time + period
    if missed >= wp.float64(constants.FOUND_SHARE):
        healthy = wp.float64(0.0)
    else:
        memory.belief[world, i].rejected_sources = wp.uint64(0)
        memory.belief[world, i].lost_time = wp.float64(0.0)
    memory.belief[world, i].healthy_time = healthy
    longest = wp.where(memory.search[world, i].active == 1, constants.MEAN_TIME, constants.LONG_TIME)
    if memory.belief[world, i].lost_time > wp.float64(longest) and many:
        declare_lost(model, memory, world, i, now.tick)
        return
    if healthy <= wp.float64(constants.MEAN_TIME) or not is_valid(own_estimate(memory, world, i)):
        return
    searching = memory.search[world, i].active == 1
    if searching and memory.search[world, i].hypotheses == 0 and is_known(memory.P[world, i, 0, 0]):
        confirm(memory, world, i)
    if memory.search[world, i].active == 0:
        noise = vec2d(wp.float64(ANCHOR_ANGLE_VARIANCE), wp.float64(ANCHOR_POSITION_VARIANCE))
        P = with_noise(wp.float64(constants.SQUARED_MARGIN) * memory.P[world, i, 0, 0], noise)
        set_anchor(memory, world, i, P, now.tick)


@device_function
def update(model: Any, state: Any, memory: Any, world: int, i: int, now: Any, frame: BearingFrame):
    """Correct the belief by the bearings of a frame that pass the gate, and test all sources, but not in a search."""
    share, rows, nis = gate(frame, memory, world, i)
    state.nis[world, i] = nis
    state.nis_dof[world, i] = rows
    if rows > 0 or share >= wp.float64(0.0):  # rejected bearings show faults
        if memory.search[world, i].active == 0:
            guard_covariance(frame, memory, world, i)
        iterated_update(frame, memory, world, i)
        if memory.search[world, i].active == 0:
            correct_sources(frame, memory, world, i)
    memory.belief[world, i].block_time += frame.period
    block = memory.belief[world, i].block_time
    if block > wp.float64(constants.SHORT_TIME - constants.SAME_TIME):
        memory.belief[world, i].block_time = wp.float64(0.0)
        if memory.search[world, i].active == 0:
            detect_and_exclude(memory, world, i, block, model.landmarks)
    if share >= wp.float64(0.0):
        note_rejections(model, memory, world, i, share, now)


@subroutine
def restart_belief(model: Any, memory: Any, world: int, i: int, estimate: PoseEstimate):
    """Restart the joint state with an own pose, which may depend on every vehicle that can be received."""
    begin_belief(memory, world, i, estimate)
    begin_sources(memory, world, i)
    memory.belief[world, i].rejected_share = wp.float64(0.0)
    memory.belief[world, i].rejected_sources = wp.uint64(0)
    memory.belief[world, i].lost_time = wp.float64(0.0)
    memory.belief[world, i].healthy_time = wp.float64(0.0)
    bits = wp.uint64(0)
    agents = model.agents
    if model.listed == 1:
        agents = model.target_count[i]
    for n in range(agents):
        target = n
        if model.listed == 1:
            target = model.targets[i, n]
        if target >= model.landmarks and target != model.landmarks + i and is_target(model, i, target):
            bits = bits | bit_of(target - model.landmarks)
    memory.belief[world, i].depends_on = bits


@subroutine
def write(state: Any, memory: Any, world: int, i: int, decides: bool):
    """Write the own estimate to the state; during a search, the best hypothesis's.

    Until measurements have confirmed it, the estimate that is tracked may be as wrong as the one that it began with.

    Protection levels are renewed where an agent `decides` by them.

    The state holds positions in the body frame and covariances of (2 lambda, p), to first order.
    """
    estimate = PoseEstimate(memory.member[world, i, 0].pose, guarded_covariance(memory, world, i))
    if memory.search[world, i].hypotheses > 0:
        estimate = memory.hypothesis[world, i, 0].estimate
    elif memory.search[world, i].active == 1:
        anchor = memory.anchor[world, i]
        step = between(anchor.odometry, memory.belief[world, i].odometry)
        before = carried(anchor.estimate, step, vec2d())
        estimate = PoseEstimate(estimate.pose, estimate.P + before.P)
    position = wp.transpose(estimate.pose.R) * estimate.pose.p
    P = symmetric_part(sheared(estimate.P, skew(position)))
    state.estimate_rotation[world, i] = type(state.estimate_rotation[world, i])(estimate.pose.R)
    state.estimate_position[world, i] = type(state.estimate_position[world, i])(position)
    state.covariance[world, i] = type(state.covariance[world, i])(P)
    if memory.search[world, i].active == 1:
        state.protection_level[world, i] = vec2d(wp.float64(wp.inf))
    elif decides:
        state.protection_level[world, i] = protection_level(memory, world, i)


@device_function
def start(model: Any, state: Any, memory: Any, world: int, i: int):
    """Start at the initial estimate, and receive the leaders' messages.

    While it is too uncertain to linearise about, hypotheses of a search compete with it.
    """
    clear(memory, world, i)
    memory.belief[world, i].first_sender = 1
    for landmark in range(model.landmarks):
        if model.landmark_std[landmark] > type(model.landmark_std[landmark])(0.0):
            memory.belief[world, i].map_errors = 1
    begin_errors(model, memory, world, i)
    R = orthonormalise(mat33d(state.estimate_rotation[world, i]))
    initial = PoseEstimate(
        Pose(R, R * vec3d(state.estimate_position[world, i])), start_covariance(model, state, world, i)
    )
    restart_belief(model, memory, world, i, initial)
    memory.belief[world, i].odometry.R = wp.identity(3, wp.float64)
    set_anchor(memory, world, i, initial.P, 0)
    if not is_known(initial.P):
        begin_search(memory, world, i)
    else:
        memory.belief[world, i].depends_on = wp.uint64(0)  # an initial estimate depends on no sender
    clear_broadcasts(memory, world, i)
    write(state, memory, world, i, True)
    receive_broadcast(model, state, memory, world, i)


@device_function
def is_tracking(memory: Any, world: int, i: int) -> bool:
    """Return whether messages and bearings correct the belief; not in a search that began with no orientation."""
    return memory.search[world, i].active == 0 or not is_vague(memory.anchor[world, i].estimate.P)


# A tick in parts; with `Embedded.parts` each is a kernel of its own on a GPU.


@device_function
def propagate_belief(model: Any, state: Any, memory: Any, world: int, i: int, now: Any):
    """Receive the messages that have been delivered, and propagate the belief, or the search, by odometry."""
    state.nis[world, i] = wp.float64(0.0)
    state.nis_dof[world, i] = 0
    receive_broadcast(model, state, memory, world, i)
    step, jump = take_odometry(model, state, memory, world, i, now.period)
    walk_errors(model, memory, world, i, now.period)
    if memory.search[world, i].active == 1:
        noise = increment_noise(model, memory, world, i, step, now.period, wp.float64(constants.MEAN_TIME)) + jump
        propagate_search(memory, world, i, step, noise)
    noise = odometry_noise(model, i, now.period) + jump
    propagate_own(memory, world, i, step, noise, now.period)


@subroutine
def accept_hypothesis(model: Any, memory: Any, world: int, i: int):
    """End a search by the single hypothesis that is left: it is the estimate, unless the tracked one agrees with it.

    A hypothesis that is too uncertain is tracked for some more frames.
    """
    found = memory.hypothesis[world, i, 0].estimate
    tracked = own_estimate(memory, world, i)
    if is_known(tracked.P) and distance_squared(tracked, found) < wp.float64(constants.POSE_GATE):
        confirm(memory, world, i)
    elif is_known(wp.float64(constants.SQUARED_MARGIN) * found.P):
        restart_belief(model, memory, world, i, found)
        memory.search[world, i] = Search()
    else:
        least = memory.search[world, i].tracked_time + wp.float64(constants.NEWS_TIME)
        memory.search[world, i].least_time = least


@device_function
def search(model: Any, state: Any, memory: Any, world: int, i: int, now: Any):
    """Search for the pose if it is not known, after the tracked estimate: no bearing of a tick corrects both."""
    if memory.search[world, i].active == 1 and now.due:
        if advance_search(model, state, memory, world, i, now):
            accept_hypothesis(model, memory, world, i)


@device_function
def fuse(model: Any, state: Any, memory: Any, world: int, i: int, now: Any):
    """Fuse the reports that are new."""
    if is_tracking(memory, world, i):
        fuse_messages(model, state, memory, world, i, now.tick)


@device_function
def correct(model: Any, state: Any, memory: Any, world: int, i: int, now: Any):
    """Correct the belief by a frame."""
    if now.due and is_tracking(memory, world, i):
        frame = set_bearing_measurements(model, state, memory, world, i, now, False)
        frame.bearings = add_readings(memory, model, state, world, i, frame)
        update(model, state, memory, world, i, now, frame)


@device_function
def conclude(model: Any, state: Any, memory: Any, world: int, i: int, now: Any):
    """Write the estimate; begin a search if it is not valid."""
    if not is_valid(own_estimate(memory, world, i)):
        declare_lost(model, memory, world, i, now.tick)  # by a message that no correct vehicle sends
    write(state, memory, world, i, now.tick % model.ticks_per_decision == 0)
    if now.due:
        state.corrected_tick[world, i] = now.tick


OPTIONS = {"max_unroll": 1}
"""Options of the Warp module. Unrolled loops make long code, which compiles slowly and runs no faster."""


def fitted(model: Any) -> Embedded:
    """Return the variant for the sensors of a model. Raises CoopenvError: it cannot take one of them."""
    kinds = {*model.sensor.numpy()["kind"].tolist()} if model.sensor.shape[0] else set()
    if -1 in kinds:
        raise CoopenvError("observer 'robust' takes a class of one's own only with functions in Warp (`in_warp`)")
    if any(number >= len(KINDS) for number in kinds):
        return with_own(tuple(sorted(kinds)))
    return WITH_READINGS if kinds else ROBUST


@cache
def with_own(numbers: tuple[int, ...]) -> Embedded:
    """Return the variant for kinds of measurements, some of them users', by their numbers.

    Raises:
        CoopenvError: a function is missing.
    """
    kinds = {number: functions_of(number) for number in numbers}
    for functions in kinds.values():
        if functions.jacobian is None:
            raise CoopenvError(f"observer 'robust': {functions.predict.key}: its class has no `jacobian` in Warp")
    name = "_".join(["robust_with_readings", *map(str, numbers)])
    Memory = memory_struct("F", FusedReading, name)
    rows_of_kind.add_overload(rows_in(Memory, kinds))
    return replace(ROBUST, name=name, memory=Memory)


ROBUST = Embedded(
    "robust",
    (propagate_belief, fuse, correct, search, conclude),
    start,
    send_broadcast,
    RobustMemory,
    ROBUST_SIZES,
    fitted,
    valid=robust_rules(),
    messages=ROBUST_MESSAGES,
    coordinates=Coordinates.LEFT,
    options=OPTIONS,
)
WITH_READINGS = replace(ROBUST, name="robust_with_readings", memory=RobustMemoryWithReadings)
"""Variant for worlds with sensors beside the camera."""


def robust(setup: Setup) -> Observer:
    """This project's observer for vehicles in space: several hypotheses, gates."""
    return KernelObserver(ROBUST, setup)
