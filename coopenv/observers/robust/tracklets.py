"""What vehicles send each other, and the information that is new in it.

A sender sends its pose, the covariance of it, and its odometry: where it would be by dead reckoning alone. So a
receiver can carry the sender's last message to the new one as the sender itself did, P- = F P F^T + Q, and what the
sender has learnt in between is P^-1 - P-^-1, whatever messages were lost. Source: the information decorrelation of
tracklets, Drummond, Tracklets and a hybrid fusion with process noise, SPIE 3163, 1997; the channel filter of Grime and
Durrant-Whyte, Data fusion in decentralized sensor networks, Control Engineering Practice 2(5), 1994.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from coopenv.estimation.so3 import orthonormalise, skew
from coopenv.observers.robust.algebra import (
    distance_squared,
    inverse6,
    is_known,
    left_error,
    log_so3,
    odometry_variances,
    transition,
    with_noise,
)
from coopenv.observers.robust.belief import append_member, fuse_information, index_of, propagate
from coopenv.observers.robust.constants import (
    AGREEMENT_DISTANCE,
    AGREEMENT_TIME,
    DEPENDENT_SHARE,
    MASK_BITS,
    MAX_VARIANCE_GROWTH,
    MESSAGE_GATE,
    TWIST_AVERAGING_TIME,
)
from coopenv.observers.robust.eviction import make_room, mark_seen
from coopenv.observers.robust.memory import Pose, Report
from coopenv.observers.robust.types import lower_blocks, mat66d, mat66f, second_half, wide_vector
from coopenv.world.camera import VISIBLE
from coopenv.world.v2x import fresh


@wp.func
def bit_of(vehicle: int) -> wp.uint64:
    """Return a vehicle as a bit; numbers from 64 on share bits with lower ones."""
    return wp.uint64(1) << wp.uint64(vehicle % MASK_BITS)


@wp.func
def possible_dependencies(model: Any, i: int) -> wp.uint64:
    """Return the vehicles that may be heard, as bits: on them the first belief may depend."""
    bits = wp.uint64(0)
    for n in range(model.target_count[i]):
        sender = model.targets[i, n] - model.landmarks
        if sender >= 0:
            bits = bits | bit_of(sender)
    return bits


@wp.func
def narrow(P: Any):
    """Return a 6x6 matrix in float32, as it is sent."""
    result = mat66f()
    for k in range(6):
        for j in range(6):
            result[k, j] = wp.float32(P[k, j])
    return result


@wp.func
def wide(P: Any):
    """Return a 6x6 matrix in float64."""
    result = mat66d()
    for k in range(6):
        for j in range(6):
            result[k, j] = wp.float64(P[k, j])
    return result


@wp.func
def marker_jacobian(marker: Any):
    """Return the derivative of the left error at a point of the body by that at its origin, 6x6."""
    one = wp.identity(3, wp.float64)
    return lower_blocks(one, -skew(marker), one)


@wp.func
def own_report(model: Any, memory: Any, world: int, i: int, tick: int):
    """Return pose, covariance and odometry at the marker, or an empty report while the pose is not known."""
    report = Report()
    report.tick = tick
    P = memory.P[world, i, 0, 0]
    if memory.search[world, i].active == 1 or not is_known(P):
        return report
    marker = wide_vector(model.scene.marker[model.landmarks + i])
    R = memory.member[world, i, 0].R
    J = marker_jacobian(marker)
    odometry = memory.belief[world, i].odometry
    report.valid = 1
    report.R = R
    report.p = memory.member[world, i, 0].p + R * marker
    report.P = narrow(J * P * wp.transpose(J))
    report.odometry = Pose(odometry.R, odometry.p + odometry.R * marker)
    report.depends_on = memory.belief[world, i].depends_on
    return report


@wp.func
def clear_messages(model: Any, memory: Any, world: int, i: int):
    """Forget what was sent and received."""
    for slot in range(model.radio.slots):
        memory.outbox[world, i, slot] = Report()
    for sender in range(model.vehicles):
        memory.inbox[world, i, sender] = Report()
        memory.inbox[world, i, sender].tick = -1


@wp.func
def send(model: Any, state: Any, memory: Any, world: int, i: int, tick: int):
    """Send a report if one is due."""
    if tick % model.radio.period == 0:
        memory.outbox[world, i, tick % model.radio.slots] = own_report(model, memory, world, i, tick)


@wp.func
def receive(model: Any, state: Any, memory: Any, world: int, i: int):
    """Take what the radio has delivered at this tick."""
    for n in range(model.target_count[i]):
        sender = model.targets[i, n] - model.landmarks
        if sender >= 0:
            sent = state.inbox_tick[world, i, sender]
            if sent >= 0 and sent != memory.inbox[world, i, sender].tick:
                memory.inbox[world, i, sender] = memory.outbox[world, sender, sent % model.radio.slots]


@wp.func
def add_member(model: Any, memory: Any, world: int, i: int, sender: int, tick: int):
    """Add a sender that is new to the belief, if there is room."""
    if not make_room(model, memory, world, i, tick):
        return
    n = memory.belief[world, i].members
    report = memory.inbox[world, i, sender]
    append_member(memory, world, i, sender, report.R, report.p, wide(report.P))
    memory.member[world, i, n].report = report
    memory.member[world, i, n].seen_tick = tick
    depends_on = report.depends_on | bit_of(sender)
    memory.belief[world, i].depends_on = memory.belief[world, i].depends_on | depends_on


@wp.func
def propagate_member(model: Any, memory: Any, world: int, i: int, n: int, dR: Any, dp: Any, dt: Any):
    """Carry a member on to its new message by its odometry, and average its twist."""
    rotation, translation = odometry_variances(model, dt)
    propagate(memory, world, i, n, dR, dp, rotation, translation)
    v = dp / dt
    w = log_so3(dR) / dt
    if memory.member[world, i, n].has_twist == 1:
        share = wp.min(wp.float64(1.0), dt / wp.float64(TWIST_AVERAGING_TIME))
        v = memory.member[world, i, n].v + share * (v - memory.member[world, i, n].v)
        w = memory.member[world, i, n].w + share * (w - memory.member[world, i, n].w)
    memory.member[world, i, n].v = v
    memory.member[world, i, n].w = w
    memory.member[world, i, n].has_twist = 1


@wp.func
def test_sender(memory: Any, world: int, i: int, n: int, R: Any, p: Any, P: Any, dt: Any):
    """Decide whether a sender is trusted, from its new report, dt after the last one, and the belief about it."""
    e = left_error(memory.member[world, i, n].R, memory.member[world, i, n].p, R, p)
    agrees = distance_squared(e, memory.P[world, i, n, n] + P) < wp.float64(MESSAGE_GATE)
    if memory.member[world, i, n].distrusted == 0:
        memory.member[world, i, n].distrusted = wp.where(agrees, 0, 1)
        memory.member[world, i, n].agreement_time = wp.float64(0.0)
        return
    agreed = wp.float64(0.0)
    if agrees and wp.length(second_half(e)) < wp.float64(AGREEMENT_DISTANCE):
        agreed = memory.member[world, i, n].agreement_time + dt
    memory.member[world, i, n].agreement_time = agreed
    memory.member[world, i, n].distrusted = wp.where(agreed >= wp.float64(AGREEMENT_TIME), 0, 1)


@wp.func
def information_share(memory: Any, world: int, i: int, depends_on: wp.uint64):
    """Return which share of its new information counts of a sender that depends on these vehicles.

    All if on none, `DEPENDENT_SHARE` if on others. Where senders depend on this vehicle in turn, each of n counts
    1 / (n + 1): then what comes back round any loop fades, however dense the graph is.
    """
    if depends_on == wp.uint64(0):
        return wp.float64(1.0)
    own = bit_of(i)
    if (depends_on & own) == wp.uint64(0):
        return wp.float64(DEPENDENT_SHARE)
    count = int(1)
    for n in range(1, memory.belief[world, i].members):
        if (memory.member[world, i, n].report.depends_on & own) != wp.uint64(0):
            count += 1
    return wp.float64(1.0) / wp.float64(count)


@wp.func
def fuse_tracklet(memory: Any, world: int, i: int, n: int, report: Any, before: Any, R: Any, p: Any):
    """Fuse what a sender has learnt since its last report, which odometry has carried on to (R, p, before)."""
    after = wide(report.P)
    for k in range(6):
        if after[k, k] > wp.float64(MAX_VARIANCE_GROWTH) * before[k, k]:
            return
    precision = inverse6(after)
    information = precision - inverse6(before)
    information = (information + wp.transpose(information)) * wp.float64(0.5)
    c = left_error(R, p, report.R, report.p)
    offset = left_error(R, p, memory.member[world, i, n].R, memory.member[world, i, n].p)
    vector = precision * c - information * offset
    share = information_share(memory, world, i, report.depends_on)
    fuse_information(memory, world, i, n, share * information, share * vector)
    memory.belief[world, i].depends_on = memory.belief[world, i].depends_on | report.depends_on


@wp.func
def fuse_message(model: Any, memory: Any, world: int, i: int, n: int, sender: int):
    """Carry a member to its new report, and fuse what it has learnt since the last one."""
    last = memory.member[world, i, n].report
    report = memory.inbox[world, i, sender]
    ticks = report.tick - last.tick
    if ticks <= 0:
        return
    dt = wp.float64(ticks) * model.camera_period
    Rt = wp.transpose(last.odometry.R)
    dR = Rt * report.odometry.R
    dp = Rt * (report.odometry.p - last.odometry.p)
    propagate_member(model, memory, world, i, n, dR, dp, dt)
    R = orthonormalise(last.R * dR)
    p = last.p + last.R * dp
    F = transition(dR, dp)
    rotation, translation = odometry_variances(model, dt)
    before = with_noise(F * wide(last.P) * wp.transpose(F), rotation, translation)
    was_distrusted = memory.member[world, i, n].distrusted
    memory.member[world, i, n].report = report
    test_sender(memory, world, i, n, report.R, report.p, wide(report.P), dt)
    if was_distrusted == 0 and memory.member[world, i, n].distrusted == 0:
        fuse_tracklet(memory, world, i, n, report, before, R, p)


@wp.func
def fuse_messages(model: Any, state: Any, memory: Any, world: int, i: int, tick: int):
    """Fuse the messages of members, and add senders in view to the belief."""
    mark_seen(model, state, memory, world, i, tick)
    for n in range(model.target_count[i]):
        target = model.targets[i, n]
        sender = target - model.landmarks
        if sender >= 0:
            if fresh(model, state, world, i, sender, tick) and memory.inbox[world, i, sender].valid == 1:
                member = index_of(memory, world, i, sender)
                if member > 0:
                    fuse_message(model, memory, world, i, member, sender)
                elif state.sight[world, i, target] == VISIBLE:
                    add_member(model, memory, world, i, sender, tick)
