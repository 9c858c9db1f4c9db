"""Hypotheses of faults of single sources.

All sources have the same prior odds. The source of a hypothesis that is nearly certain is excluded: unless the gate has
rejected its bearings, the covariance grows by the difference and the added uncertainty of the solution without it. An
own sensor stays in use: its fault becomes an error of its calibration, correlated with the error that it has caused.
Hypotheses that are only likely add to the covariance that is stated and sent, each by its probability. An excluded
source stays under test, and is readmitted when its bearings fit without a fault and not with the one it had.
"""

from typing import Any

import warp as wp

from coopenv.estimation.linalg import symmetric_part
from coopenv.observers.robust import constants
from coopenv.observers.robust.algebra import mat33d, mat63d, mat66d, vec3d, vec6d
from coopenv.observers.robust.integrity import end_block, restart_fault
from coopenv.observers.robust.joint_state import begin_calibration, insert_member, mounting_of, remove_member, set_block
from coopenv.observers.robust.linearisation import innovation_weight
from coopenv.observers.robust.memory import ERRORS, FOCAL_ERROR, MOUNTING, SENDER_SLOTS, SOURCES, BearingFrame, fill
from coopenv.observers.robust.messages import includes
from coopenv.observers.robust.sources import (
    CAMERA,
    FOCAL,
    GYRO,
    VELOCITY,
    clear_drift,
    clear_source,
    is_active,
    is_own,
    is_rejected,
    is_sender,
    member_of,
)
from coopenv.world.warp_internals import device_function, subroutine


@device_function
def spread_of(memory: Any, world: int, i: int, q: int):
    """Return the covariance (3, 3) that a fault of a source adds to the source's error.

    It is zero if the gate rejects the source's bearings, which then do not enter the estimate.
    """
    f = memory.source[world, i, q].offset
    spread = memory.source[world, i, q].covariance + wp.outer(f, f)
    if is_rejected(memory, world, i, q):
        spread = mat33d()
    return spread


@subroutine
def inflate_by_fault(memory: Any, world: int, i: int, q: int):
    """Inflate the covariance by the difference and the added uncertainty of the solution without a source.

    The pose stays: the share of a recent fault in it is unknown, and the next bearings will reveal it.
    """
    spread = spread_of(memory, world, i, q)
    for o in range(memory.belief[world, i].first_sender):
        X = memory.sensitivity[world, i, q, o] * spread
        for j in range(o + 1):
            block = memory.P[world, i, o, j] + X * wp.transpose(memory.sensitivity[world, i, q, j])
            set_block(memory, world, i, o, j, block)
    fill(memory.sensitivity[world, i, q], mat63d())


@device_function
def add_to_calibration(memory: Any, world: int, i: int, q: int):
    """Let the fault of an own sensor be an error of the odometry's scale, the gyro's bias or the camera's mounting."""
    if q == VELOCITY:
        v = memory.belief[world, i].mean_v
        square = wp.dot(v, v)
        if square > wp.float64(constants.MIN_VELOCITY_STD * constants.MIN_VELOCITY_STD):
            memory.sensitivity[world, i, q, ERRORS][3] -= v / square
    elif q == FOCAL:
        memory.sensitivity[world, i, q, ERRORS][FOCAL_ERROR, 0] += wp.float64(1.0)
    elif q == GYRO:
        for k in range(3):
            memory.sensitivity[world, i, q, ERRORS][k, k] -= wp.float64(1.0)
    elif q == CAMERA:
        if mounting_of(memory, world, i) == 0:
            insert_member(memory, world, i, MOUNTING)
            begin_calibration(memory, world, i, MOUNTING, vec6d())
        for k in range(3):
            memory.sensitivity[world, i, q, MOUNTING][k, k] += wp.float64(1.0)


@device_function
def set_walk(memory: Any, world: int, i: int):
    """Let the odometry's scale walk from the velocity's second fault on, by as much as between the last two."""
    if memory.source[world, i, VELOCITY].exclusions > 1:
        v = memory.belief[world, i].mean_v
        along = wp.dot(memory.source[world, i, VELOCITY].offset, v)
        square = along * along / wp.max(wp.length_sq(v) * wp.length_sq(v), wp.float64(constants.MIN_VARIANCE))
        memory.source[world, i, VELOCITY].walk = square / memory.source[world, i, VELOCITY].time
    memory.source[world, i, VELOCITY].time = wp.float64(0.0)


@device_function
def forget_faults(memory: Any, world: int, i: int):
    """Begin all sums anew; excluded sources stay so."""
    for c in range(SOURCES):
        if is_active(memory, world, i, c):
            memory.source[world, i, c].sum = vec3d()
            memory.source[world, i, c].information = mat33d()
            if is_sender(c):
                clear_drift(memory, world, i, c)
            if c >= CAMERA:
                restart_fault(memory, world, i, c)


@subroutine
def exclude(memory: Any, world: int, i: int, q: int):
    """Exclude a source; an own sensor stays in use, with an uncertain scale, bias or mounting."""
    memory.source[world, i, q].exclusions += 1
    if is_own(q):
        if q == VELOCITY:
            set_walk(memory, world, i)
        add_to_calibration(memory, world, i, q)
        inflate_by_fault(memory, world, i, q)
        return
    if drifts(memory, world, i, q):
        memory.source[world, i, q].offset = -memory.source[world, i, q].drift
    else:
        inflate_by_fault(memory, world, i, q)
    f = memory.source[world, i, q].offset
    clear_source(memory, world, i, q)
    memory.source[world, i, q].offset = f
    memory.source[world, i, q].excluded = 1
    memory.source[world, i, q].time = wp.float64(0.0)
    k = member_of(memory, world, i, q)
    if k > 0:
        remove_member(memory, world, i, k)


@device_function
def drifts(memory: Any, world: int, i: int, q: int) -> bool:
    """Return whether a sender nearly certainly drifts from its own odometry, for longer than a correct one needs.

    A sender with a faulty sensor moves until its own monitor finds that, at the end of a block.
    """
    certain = memory.source[world, i, q].drift_ratio > wp.float64(constants.FAULT_GATE + constants.ODDS)
    lasting = memory.source[world, i, q].drift_time > wp.float64(constants.MEAN_TIME - constants.SAME_TIME)
    return is_sender(q) and is_active(memory, world, i, q) and certain and lasting


@device_function
def upstream_fault_explains_drift(memory: Any, world: int, i: int, q: int, landmarks: int) -> bool:
    """Return whether a sender depends on another sender with a fault that would explain its drift."""
    depends_on = memory.member[world, i, member_of(memory, world, i, q)].report.depends_on
    for c in range(1, 1 + SENDER_SLOTS):
        vehicle = memory.source[world, i, c].target - landmarks
        if c != q and is_active(memory, world, i, c) and includes(depends_on, vehicle):
            evidence = wp.max(memory.source[world, i, c].ratio, memory.source[world, i, c].drift_ratio)
            if evidence > wp.float64(constants.ODDS):
                return True
    return False


@device_function
def exclude_drifting(memory: Any, world: int, i: int, landmarks: int) -> bool:
    """Exclude all senders that drift, and return whether there are any; no other fault explains their drift."""
    found = bool(False)
    for q in range(1, 1 + SENDER_SLOTS):
        if drifts(memory, world, i, q) and not upstream_fault_explains_drift(memory, world, i, q, landmarks):
            exclude(memory, world, i, q)
            found = True
    return found


@device_function
def set_fault_mixture(memory: Any, world: int, i: int, most: Any, total: Any):
    """Set the mixture covariance, which the hypotheses of single faults add to the covariance of the own pose.

    A hypothesis of a probability w adds the covariance of the solution without the source and the square of its
    distance, both times w.
    """
    mixture = mat66d()
    for q in range(SOURCES):
        if is_active(memory, world, i, q):
            w = weight_of(memory.source[world, i, q].ratio, most) / total
            Phi = memory.sensitivity[world, i, q, 0]
            mixture += w * (Phi * spread_of(memory, world, i, q) * wp.transpose(Phi))
    memory.fault_mixture[world, i] = symmetric_part(mixture)


@subroutine
def detect_and_exclude(memory: Any, world: int, i: int, time: Any, landmarks: int):
    """Weigh the hypotheses after a block of a time, s; exclude the source of one nearly certain, own sensors first.

    Soon after it began, a fault of the gyro looks like one of the camera: if both are likelier than none, both
    count as faulty. While most bearings fail the gate, innovations of a wrong pose reveal faults of own sensors only.
    """
    end_block(memory, world, i, time)
    memory.fault_mixture[world, i] = mat66d()
    lost = memory.belief[world, i].lost_time > wp.float64(0.0)
    gate = wp.float64(constants.FAULT_GATE)
    most = gate
    worst = int(-1)
    for q in range(SOURCES):
        if is_active(memory, world, i, q) and memory.source[world, i, q].ratio > most:
            most = memory.source[world, i, q].ratio
            worst = q
    total = weight_of(gate, most)
    rivals = total
    for q in range(SOURCES):
        if is_active(memory, world, i, q):
            w = weight_of(memory.source[world, i, q].ratio, most)
            total += w
            if not is_same(q, worst):
                rivals += w
    certain = worst >= 0 and rivals < wp.float64(constants.FAULT_RISK)
    if not (certain and is_own(worst)) and not lost and exclude_drifting(memory, world, i, landmarks):
        forget_faults(memory, world, i)
        return
    if certain and (is_own(worst) or not lost):
        for q in range(SOURCES):
            likely = memory.source[world, i, q].ratio > most - wp.float64(constants.ODDS)
            turned = q >= CAMERA and worst >= CAMERA and memory.source[world, i, q].ratio > wp.float64(constants.ODDS)
            if is_same(q, worst) and (likely or turned):
                exclude(memory, world, i, q)
    if certain or lost:
        forget_faults(memory, world, i)
    elif worst >= 0:
        set_fault_mixture(memory, world, i, most, total)


@wp.func
def is_same(q: int, c: int) -> bool:
    """Return whether two slots are the same source; all own sensors count as one, because all of them stay in use."""
    return q == c or (is_own(q) and is_own(c))


@wp.func
def weight_of(ratio: Any, most: Any):
    """Return the weight of a hypothesis by its likelihood, relative to the most likely one's."""
    return wp.exp(wp.float64(0.5) * (ratio - most))


@device_function
def test_excluded(frame: BearingFrame, memory: Any, world: int, i: int, n: int, q: int):
    """Readmit an excluded source if its bearings fit well without an offset, and not with the one at the exclusion.

    Only bearings that pass the gate count: a source of which some are outliers returns. Errors of the own pose are the
    same in many frames, so that all frames together count as one.
    """
    H = -(memory.derivative[world, i, n, 0].jacobian[:, 3:] * wp.transpose(memory.member[world, i, 0].pose.R))
    W = innovation_weight(memory, world, i, n, memory.measurement[world, i, n].noise)
    share = wp.min(frame.period / wp.float64(constants.LONG_TIME), wp.float64(1.0))
    HW = share * (wp.transpose(H) * W)
    kept = wp.float64(1.0) - share
    A = kept * memory.source[world, i, q].information + HW * H
    a = kept * memory.source[world, i, q].sum + HW * memory.measurement[world, i, n].residual
    memory.source[world, i, q].information = A
    memory.source[world, i, q].sum = a
    memory.source[world, i, q].time += frame.period
    f = memory.source[world, i, q].offset
    least = wp.float64(constants.ROUNDING) * wp.trace(A) + wp.float64(constants.MIN_VARIANCE)
    present = wp.dot(a, wp.inverse(A + least * wp.identity(3, wp.float64)) * a)
    gain = wp.dot(f, A * f) - wp.float64(2.0) * wp.dot(f, a)
    fits = present < wp.float64(constants.BEARING_GATE) and gain > wp.float64(constants.BEARING_GATE)
    if fits and memory.source[world, i, q].time > wp.float64(constants.LONG_TIME):
        memory.source[world, i, q].excluded = 0
        clear_source(memory, world, i, q)
