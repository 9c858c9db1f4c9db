"""Fusion of reports whose errors correlate with the vehicle's own error.

Senders are considered (Schmidt): a member has the reported pose and covariance, its error correlates with the vehicle's
own, and bearings do not correct it. When a report moves a sender by d from its propagated pose, its error changes from
e- to e+ = e- - d. As e+ is not correlated with d, d has the covariance N = P- - P+. With any other error y,
cov(y, d) = cov(y, e-) - cov(y, e+). The own pose is corrected with that covariance over N as the gain.
Source: Schmidt, Application of state-space methods to navigation problems, Advances in Control Systems 3, 1966.

Clock offsets of a declared standard deviation s are considered like the sender's own error. They add 2 s^2 v v^T to the
reported covariance, for the sender's clock and the receiver's, and correlate with all later errors.
"""

from typing import Any

import warp as wp

from coopenv.estimation.linalg import THIRD, block3, symmetric_part
from coopenv.observers.robust import algebra, constants
from coopenv.observers.robust.algebra import Pose, PoseEstimate, mat66d, vec6d
from coopenv.observers.robust.correlations import (
    by_clocks,
    is_positive,
    rank,
    regress,
    stated_covariance,
)
from coopenv.observers.robust.integrity import add_to_drift
from coopenv.observers.robust.joint_state import (
    TWELFTH,
    apply_corrections,
    index_of,
    insert_member,
    make_room,
    mark_seen,
    recentre,
    set_block,
)
from coopenv.observers.robust.measurements import is_received
from coopenv.observers.robust.memory import LANDMARK_SLOTS, SENDER_SLOTS, Member
from coopenv.observers.robust.messages import bit_of, depends_on_own, includes, propagate_member
from coopenv.observers.robust.sources import clear_drift, clear_source, is_excluded, is_seen, take_slot
from coopenv.world.nearby import box_of, box_of_entry, entry_at, entry_count, sender_of
from coopenv.world.warp_internals import device_function, subroutine


@device_function
def update_clock_velocity(model: Any, memory: Any, world: int, i: int, n: int) -> bool:
    """Update the velocity at which clock offsets count, if member n's velocity has changed much; return whether it has.

    An update at every change would count each of them as a new error.
    """
    if model.fault[i].clock == type(model.fault[i].clock)(0.0):
        return False
    v = memory.member[world, i, n].v
    before = memory.member[world, i, n].clock_v
    share = wp.float64(constants.SHARE_OF_CHANGE * constants.SHARE_OF_CHANGE)
    if wp.length_sq(v - before) <= share * wp.length_sq(before) + memory.member[world, i, n].velocity_variance:
        return False
    memory.member[world, i, n].clock_v = v
    P = memory.P[world, i, n, n] + by_clocks(model, memory, world, i, n)
    memory.P[world, i, n, n] = symmetric_part(P)
    return True


@device_function
def set_row(memory: Any, world: int, i: int, n: int):
    """Write `scratch.row` to row and column n of the covariance."""
    for k in range(memory.belief[world, i].members):
        set_block(memory, world, i, n, k, memory.scratch[world, i, k].row)


@subroutine
def set_to_report(model: Any, memory: Any, world: int, i: int, n: int):
    """Set a member to the pose and covariance of its report, without its earlier estimate."""
    memory.member[world, i, n].pose = memory.member[world, i, n].report.pose
    regress(model, memory, world, i, n, False)
    set_row(memory, world, i, n)


@subroutine
def add_member(model: Any, state: Any, memory: Any, world: int, i: int, sender: int, tick: int):
    """Add a sender that is new to the belief, if there is room."""
    if make_room(model, memory, world, i, tick):
        n = memory.belief[world, i].members
        q = take_slot(memory, world, i, model.landmarks + sender, tick, False, model.camera_period)
        if not is_excluded(memory, world, i, q):
            clear_source(memory, world, i, q)
        member = Member()
        member.vehicle = sender
        member.source = q
        member.box = box_of(model, state, world, i, sender)
        member.report = memory.inbox[world, i, member.box]
        member.seen_tick = tick
        member.correlation_unknown = wp.where(includes(memory.belief[world, i].depends_on, sender), 1, 0)
        insert_member(memory, world, i, n)
        memory.member[world, i, n] = member
        set_to_report(model, memory, world, i, n)
        depends_on = member.report.depends_on | bit_of(sender)
        memory.belief[world, i].depends_on = memory.belief[world, i].depends_on | depends_on


@device_function
def correct_sensitivities(memory: Any, world: int, i: int, inverse: Any):
    """Correct the sensitivities to errors of the map by an increment of inverse covariance `inverse`.

    As a measurement of the own error that does not depend on the map; otherwise the estimated errors would
    depend on it more than their covariance allows.
    """
    H = memory.scratch[world, i, 0].column * algebra.inverse6(memory.P[world, i, 0, 0])
    for slot in range(LANDMARK_SLOTS):
        q = 1 + SENDER_SLOTS + slot
        if memory.source[world, i, q].map_variance > wp.float64(0.0):
            weighted = inverse * (H * memory.sensitivity[world, i, q, 0])
            for k in range(memory.belief[world, i].first_sender):
                change = wp.transpose(memory.scratch[world, i, k].column) * weighted
                memory.sensitivity[world, i, q, k] = memory.sensitivity[world, i, q, k] - change


@subroutine
def apply_sender_increment(memory: Any, world: int, i: int, n: int, d: Any):
    """Correct the own pose by a sender's increment d. `scratch.column` holds cov(d, y) for errors y, `known` cov(d)."""
    members = memory.belief[world, i].members
    first_sender = memory.belief[world, i].first_sender
    inverse = algebra.inverse6(memory.known[world, i, 0].covariance)
    if memory.belief[world, i].map_errors == 1:
        correct_sensitivities(memory, world, i, inverse)
    for k in range(first_sender):
        gain = wp.transpose(memory.scratch[world, i, k].column) * inverse
        memory.scratch[world, i, k].correction = gain * d
        for j in range(k, members):
            set_block(memory, world, i, k, j, memory.P[world, i, k, j] - gain * memory.scratch[world, i, j].column)
    for k in range(first_sender, members):
        memory.scratch[world, i, k].correction = vec6d()
    apply_corrections(memory, world, i)


@subroutine
def set_increment(memory: Any, world: int, i: int, n: int):
    """Set a member to the pose of its new report, and return the increment from the old pose, (6,)."""
    report = memory.member[world, i, n].report
    shift = algebra.left_error(memory.member[world, i, n].pose, report.pose)
    G = algebra.recentring(shift)
    recentre(memory, world, i, n, G)
    memory.member[world, i, n].pose = report.pose
    return G * shift


@subroutine
def fuse_increment(model: Any, memory: Any, world: int, i: int, n: int, fusing: bool, unknown: Any):
    """Set a member to its new report, and correct the own pose by the increment if `fusing`."""
    d = set_increment(memory, world, i, n)
    regress(model, memory, world, i, n, True)
    for k in range(memory.belief[world, i].members):
        memory.scratch[world, i, k].column = memory.P[world, i, n, k] - memory.scratch[world, i, k].row
    after = stated_covariance(model, memory, world, i, n)
    memory.scratch[world, i, n].column = after - memory.scratch[world, i, n].row
    before = mat66d(memory.P[world, i, n, n])
    N = before - after - memory.scratch[world, i, n].column
    known = block3(N, 3, 3)
    drift = wp.where(wp.trace(known) < wp.float64(0.0), unknown, known + unknown)
    R = memory.member[world, i, n].pose.R
    add_to_drift(memory, world, i, memory.member[world, i, n].source, R * d[3:], R * drift * wp.transpose(R))
    N = N + wp.diag(wp.float64(constants.LEAST_NEWS) * wp.get_diag(before))
    memory.known[world, i, 0].covariance = N
    variance = algebra.position_variance(before)
    set_row(memory, world, i, n)
    away = memory.member[world, i, n].pose.p - memory.member[world, i, 0].pose.p
    reach = wp.float64(constants.LINEAR_ANGLE) * wp.length(away)
    if fusing and variance <= wp.float64(3.0) * reach * reach and is_positive(N):
        if wp.length_sq(algebra.inverse_factor(N) * d) <= wp.float64(constants.POSE_GATE):
            apply_sender_increment(memory, world, i, n, d)


@device_function
def inflate_dependents(memory: Any, world: int, i: int, n: int, variance: Any):
    """Add a variance (m^2 per axis) to member n's position, and to all errors that depend on it."""
    members = memory.belief[world, i].members
    inverse = algebra.inverse6(memory.P[world, i, n, n])
    for k in range(members):
        memory.scratch[world, i, k].column = memory.P[world, i, k, n] * inverse
    for k in range(members):
        A = memory.scratch[world, i, k].column
        for j in range(k + 1):
            B = memory.scratch[world, i, j].column
            block = memory.P[world, i, k, j] + variance * (A[:, 3:] * wp.transpose(B[:, 3:]))
            set_block(memory, world, i, k, j, block)


@device_function
def sender_reset_detected(memory: Any, world: int, i: int, n: int, dt: Any) -> bool:
    """Inflate the covariance where member n's new report shows a reset; return whether to replace the old report.

    A reset shows as a covariance that has grown much, or as a jump of the position after a long silence. A jump alone
    inflates nothing: the new position may be the wrong one; later bearings are tested against it.
    """
    report = memory.member[world, i, n].report
    P = mat66d(report.P)
    before = memory.P[world, i, n, n]
    spread = algebra.position_variance(before)
    grown = algebra.position_variance(P) - spread
    if grown > wp.float64(constants.DISTINCT_VARIANCES - 1.0) * spread:
        inflate_dependents(memory, world, i, n, wp.float64(THIRD) * grown)
        clear_drift(memory, world, i, memory.member[world, i, n].source)
    if dt > wp.float64(constants.SHORT_TIME):
        estimated = PoseEstimate(memory.member[world, i, n].pose, memory.P[world, i, n, n])
        if algebra.distance_squared(estimated, PoseEstimate(report.pose, P)) > wp.float64(constants.POSE_GATE):
            return True
    return False


@device_function
def unknown_covariance(model: Any, memory: Any, world: int, i: int, n: int, step: Pose, dt: Any):
    """Return the covariance (3, 3), m^2 and body, of an increment of member n over dt by the sender's unknown errors.

    These are the scale error of the sender's odometry, and sudden changes of its twist.
    """
    p = wp.transpose(step.R) * step.p
    declared = wp.float64(model.noise[i].odometry_scale)
    scale = declared * declared + wp.float64(constants.CALIBRATION_CHANGE * constants.CALIBRATION_CHANGE)
    C = (scale * wp.max(wp.float64(1.0), wp.float64(constants.MEAN_TIME) / dt)) * wp.outer(p, p)
    if memory.member[world, i, n].has_twist == 1:
        change = (step.p / dt - memory.member[world, i, n].v) * model.odometry_period
        C = C + (wp.float64(TWELFTH) * wp.length_sq(change)) * wp.identity(3, wp.float64)
    return C


@device_function
def fuse_report(model: Any, memory: Any, world: int, i: int, n: int):
    """Propagate a member to its new report, and fuse it."""
    last = memory.member[world, i, n].report
    report = memory.inbox[world, i, memory.member[world, i, n].box]
    dt = wp.float64(report.tick - last.tick) * model.camera_period
    step = algebra.between(last.odometry, report.odometry)
    white = algebra.odometry_noise(model, i, dt)
    unknown = unknown_covariance(model, memory, world, i, n, step, dt)
    propagate_member(model, memory, world, i, n, step, dt, white)
    steady = not update_clock_velocity(model, memory, world, i, n)
    memory.member[world, i, n].report = report
    q = memory.member[world, i, n].source
    if is_excluded(memory, world, i, q):
        set_to_report(model, memory, world, i, n)
        return
    memory.belief[world, i].depends_on = memory.belief[world, i].depends_on | report.depends_on
    if sender_reset_detected(memory, world, i, n, dt):
        clear_source(memory, world, i, q)
        set_to_report(model, memory, world, i, n)
    else:
        fuse_increment(model, memory, world, i, n, steady and not depends_on_own(memory, world, i, n), unknown)


@device_function
def is_pending(model: Any, state: Any, memory: Any, world: int, i: int, n: int, tick: int) -> bool:
    """Return whether a report of member n that carries correlations is received and not yet fused."""
    box = memory.member[world, i, n].box
    if not is_received(model, state, memory, world, i, box, tick):
        return False
    report = memory.inbox[world, i, box].tick
    return memory.inbox[world, i, box].carries_correlations == 1 and report > memory.member[world, i, n].report.tick


@device_function
def next_member(model: Any, state: Any, memory: Any, world: int, i: int, tick: int) -> int:
    """Return the member whose report is fused next, 0 if there is none: leaders before followers."""
    found = int(0)
    best = int(0)
    for n in range(memory.belief[world, i].first_sender, memory.belief[world, i].members):
        if is_pending(model, state, memory, world, i, n, tick):
            at = rank(model, memory.member[world, i, n].vehicle, memory.inbox[world, i, memory.member[world, i, n].box])
            if found == 0 or at < best:
                found = n
                best = at
    return found


@device_function
def next_new_sender(model: Any, state: Any, memory: Any, world: int, i: int, last: int, tick: int) -> int:
    """Return the next rank above `last` of vehicles in view that are received and no members; -1 if none is left.

    The vehicle is the rank modulo the number of vehicles.
    """
    best = int(-1)
    kept = model.kept
    for n in range(entry_count(model, state, world, i)):
        entry = entry_at(model, state, kept, world, i, n)
        box = box_of_entry(model, entry)
        seen = is_seen(state, world, i, entry, tick)
        if seen and is_received(model, state, memory, world, i, box, tick):
            sender = sender_of(model, state, world, i, box)
            if index_of(memory, world, i, sender) == 0:
                at = rank(model, sender, memory.inbox[world, i, box])
                if at > last and (best < 0 or at < best):
                    best = at
    return best


@subroutine
def fuse_messages(model: Any, state: Any, memory: Any, world: int, i: int, tick: int):
    """Fuse the members' reports that carry correlations, then add new senders in view to the belief."""
    mark_seen(model, state, memory, world, i, tick)
    for _ in range(memory.belief[world, i].members):
        n = next_member(model, state, memory, world, i, tick)
        if n == 0:
            break
        fuse_report(model, memory, world, i, n)
    at = int(-1)
    for _ in range(entry_count(model, state, world, i)):
        at = next_new_sender(model, state, memory, world, i, at, tick)
        if at < 0:
            break
        add_member(model, state, memory, world, i, at % model.vehicles, tick)
