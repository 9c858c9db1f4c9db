"""What vehicles tell each other, and what is new in it. See observers/robust/report.py."""

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
from coopenv.observers.robust.belief import add, inform, move
from coopenv.observers.robust.eviction import make_room
from coopenv.observers.robust.reference.belief import TWIST_TIME
from coopenv.observers.robust.reference.observer import AGREED_DISTANCE, AGREED_FOR, SHARE, TRUST_GATE
from coopenv.observers.robust.reference.tracklets import BITS
from coopenv.observers.robust.types import lower_blocks, mat66d, mat66f, second_half, wide_vector

RUMOUR_SHARE = wp.constant(SHARE)
MOST_DISTANCE = wp.constant(TRUST_GATE)
PROBATION, CLOSE = wp.constant(AGREED_FOR), wp.constant(AGREED_DISTANCE)
TWIST_MEMORY = wp.constant(TWIST_TIME)
MASK_BITS = wp.constant(BITS)
LESS_KNOWN = wp.constant(1.01)
"""Ratio of a variance to the predicted one: from there on the sender has lost something, and nothing is learnt."""


@wp.func
def bit_of(vehicle: int) -> wp.uint64:
    """Return a vehicle as a bit; numbers from 64 on share bits with lower ones."""
    return wp.uint64(1) << wp.uint64(vehicle % MASK_BITS)


@wp.func
def may_lean_on(model: Any, i: int) -> wp.uint64:
    """Return the vehicles that may be heard, as bits."""
    bits = wp.uint64(0)
    for n in range(model.target_count[i]):
        sender = model.targets[i, n] - model.landmarks
        if sender >= 0:
            bits = bits | bit_of(sender)
    return bits


@wp.func
def tell(model: Any, mind: Any, world: int, i: int, tick: int):
    """Put pose, covariance and odometry on the air if a message is due; an empty one while the pose is not known."""
    if tick % model.radio.period != 0:
        return
    slot = tick % model.radio.slots
    says = int(0)
    P = mind.P[world, i, 0, 0]
    if mind.searching[world, i] == 0 and is_known(P):
        says = int(1)
        marker = wide_vector(model.scene.marker[model.landmarks + i])
        R = mind.R[world, i, 0]
        one = wp.identity(3, wp.float64)
        J = lower_blocks(one, -skew(marker), one)
        seen = J * P * wp.transpose(J)
        told = mat66f()
        for k in range(6):
            for j in range(6):
                told[k, j] = wp.float32(seen[k, j])
        odometry = mind.odometry_rotation[world, i]
        mind.outbox_rotation[world, i, slot] = R
        mind.outbox_position[world, i, slot] = mind.p[world, i, 0] + R * marker
        mind.outbox_covariance[world, i, slot] = told
        mind.outbox_odometry_rotation[world, i, slot] = odometry
        mind.outbox_odometry_position[world, i, slot] = mind.odometry_position[world, i] + odometry * marker
        mind.outbox_leans_on[world, i, slot] = mind.leans_on[world, i]
    mind.outbox_says[world, i, slot] = says


@wp.func
def collect(model: Any, state: Any, mind: Any, world: int, i: int):
    """Take what the radio has delivered at this tick."""
    for n in range(model.target_count[i]):
        sender = model.targets[i, n] - model.landmarks
        if sender >= 0:
            sent = state.inbox_tick[world, i, sender]
            if sent >= 0 and sent != mind.inbox_tick[world, i, sender]:
                slot = sent % model.radio.slots
                mind.inbox_tick[world, i, sender] = sent
                mind.inbox_says[world, i, sender] = mind.outbox_says[world, sender, slot]
                mind.inbox_rotation[world, i, sender] = mind.outbox_rotation[world, sender, slot]
                mind.inbox_position[world, i, sender] = mind.outbox_position[world, sender, slot]
                mind.inbox_covariance[world, i, sender] = mind.outbox_covariance[world, sender, slot]
                mind.inbox_odometry_rotation[world, i, sender] = mind.outbox_odometry_rotation[world, sender, slot]
                mind.inbox_odometry_position[world, i, sender] = mind.outbox_odometry_position[world, sender, slot]
                mind.inbox_leans_on[world, i, sender] = mind.outbox_leans_on[world, sender, slot]


@wp.func
def covariance_heard(mind: Any, world: int, i: int, sender: int):
    """Return the covariance in a sender's last message."""
    P = mind.inbox_covariance[world, i, sender]
    wide = mat66d()
    for k in range(6):
        for j in range(6):
            wide[k, j] = wp.float64(P[k, j])
    return wide


@wp.func
def remember(mind: Any, world: int, i: int, n: int, sender: int):
    """Keep a member's message as its last one."""
    mind.report_tick[world, i, n] = mind.inbox_tick[world, i, sender]
    mind.report_rotation[world, i, n] = mind.inbox_rotation[world, i, sender]
    mind.report_position[world, i, n] = mind.inbox_position[world, i, sender]
    mind.report_covariance[world, i, n] = covariance_heard(mind, world, i, sender)
    mind.report_odometry_rotation[world, i, n] = mind.inbox_odometry_rotation[world, i, sender]
    mind.report_odometry_position[world, i, n] = mind.inbox_odometry_position[world, i, sender]
    mind.report_leans_on[world, i, n] = mind.inbox_leans_on[world, i, sender]


@wp.func
def meet(model: Any, mind: Any, world: int, i: int, sender: int, tick: int):
    """Take in a sender that is new, if there is room."""
    if not make_room(model, mind, world, i, tick):
        return
    n = mind.members[world, i]
    R = mind.inbox_rotation[world, i, sender]
    add(mind, world, i, sender, R, mind.inbox_position[world, i, sender], covariance_heard(mind, world, i, sender))
    remember(mind, world, i, n, sender)
    mind.seen_tick[world, i, n] = tick
    mind.distrusted[world, i, n] = 0
    mind.agreed[world, i, n] = wp.float64(0.0)
    leans_on = mind.inbox_leans_on[world, i, sender] | bit_of(sender)
    mind.leans_on[world, i] = mind.leans_on[world, i] | leans_on


@wp.func
def carry(model: Any, mind: Any, world: int, i: int, n: int, dR: Any, dp: Any, dt: Any):
    """Carry a member on to its new message by its odometry, and average its twist."""
    rotation, translation = odometry_variances(model, dt)
    move(mind, world, i, n, dR, dp, rotation, translation)
    v = dp / dt
    w = log_so3(dR) / dt
    if mind.twists[world, i, n] == 1:
        share = wp.min(wp.float64(1.0), dt / wp.float64(TWIST_MEMORY))
        v = mind.v[world, i, n] + share * (v - mind.v[world, i, n])
        w = mind.w[world, i, n] + share * (w - mind.w[world, i, n])
    mind.v[world, i, n] = v
    mind.w[world, i, n] = w
    mind.twists[world, i, n] = 1


@wp.func
def judge(mind: Any, world: int, i: int, n: int, R: Any, p: Any, P: Any, dt: Any):
    """Decide whether a sender is believed, from its message and the belief about it."""
    e = left_error(mind.R[world, i, n], mind.p[world, i, n], R, p)
    agrees = distance_squared(e, mind.P[world, i, n, n] + P) < wp.float64(MOST_DISTANCE)
    if mind.distrusted[world, i, n] == 0:
        mind.distrusted[world, i, n] = wp.where(agrees, 0, 1)
        mind.agreed[world, i, n] = wp.float64(0.0)
        return
    agreed = wp.float64(0.0)
    if agrees and wp.length(second_half(e)) < wp.float64(CLOSE):
        agreed = mind.agreed[world, i, n] + dt
    mind.agreed[world, i, n] = agreed
    mind.distrusted[world, i, n] = wp.where(agreed >= wp.float64(PROBATION), 0, 1)


@wp.func
def share_of(mind: Any, world: int, i: int, leans_on: wp.uint64):
    """Return how much of the news counts of a sender that leans on these vehicles.

    All if on nobody. Of n senders that lean on this vehicle in turn each counts 1 / (n + 1).
    """
    if leans_on == wp.uint64(0):
        return wp.float64(1.0)
    own = bit_of(i)
    if (leans_on & own) == wp.uint64(0):
        return wp.float64(RUMOUR_SHARE)
    count = int(1)
    for n in range(1, mind.members[world, i]):
        if (mind.report_leans_on[world, i, n] & own) != wp.uint64(0):
            count += 1
    return wp.float64(1.0) / wp.float64(count)


@wp.func
def learn(mind: Any, world: int, i: int, n: int, sender: int, before: Any, R: Any, p: Any):
    """Take in what a sender has learnt since its last message, which odometry has carried on to (R, p, before)."""
    after = covariance_heard(mind, world, i, sender)
    for k in range(6):
        if after[k, k] > wp.float64(LESS_KNOWN) * before[k, k]:
            return
    precision = inverse6(after)
    information = precision - inverse6(before)
    information = (information + wp.transpose(information)) * wp.float64(0.5)
    c = left_error(R, p, mind.inbox_rotation[world, i, sender], mind.inbox_position[world, i, sender])
    offset = left_error(R, p, mind.R[world, i, n], mind.p[world, i, n])
    vector = precision * c - information * offset
    share = share_of(mind, world, i, mind.inbox_leans_on[world, i, sender])
    inform(mind, world, i, n, share * information, share * vector)
    mind.leans_on[world, i] = mind.leans_on[world, i] | mind.inbox_leans_on[world, i, sender]


@wp.func
def hear(model: Any, mind: Any, world: int, i: int, n: int, sender: int):
    """Carry a sender to its new message, and take in what it has learnt since the last one."""
    ticks = mind.inbox_tick[world, i, sender] - mind.report_tick[world, i, n]
    if ticks <= 0:
        return
    dt = wp.float64(ticks) * model.camera_period
    Rt = wp.transpose(mind.report_odometry_rotation[world, i, n])
    dR = Rt * mind.inbox_odometry_rotation[world, i, sender]
    dp = Rt * (mind.inbox_odometry_position[world, i, sender] - mind.report_odometry_position[world, i, n])
    carry(model, mind, world, i, n, dR, dp, dt)
    last = mind.report_rotation[world, i, n]
    R = orthonormalise(last * dR)
    p = mind.report_position[world, i, n] + last * dp
    F = transition(dR, dp)
    rotation, translation = odometry_variances(model, dt)
    before = with_noise(F * mind.report_covariance[world, i, n] * wp.transpose(F), rotation, translation)
    was_distrusted = mind.distrusted[world, i, n]
    remember(mind, world, i, n, sender)
    judge(
        mind,
        world,
        i,
        n,
        mind.report_rotation[world, i, n],
        mind.report_position[world, i, n],
        mind.report_covariance[world, i, n],
        dt,
    )
    if was_distrusted == 0 and mind.distrusted[world, i, n] == 0:
        learn(mind, world, i, n, sender, before, R, p)
