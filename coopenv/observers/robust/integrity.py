"""Integrity: one monitor per source of information (landmarks, senders, own sensors), and protection levels.

A fault of a source is an unknown vector f: the offset of a landmark from its place in the map, or of a sender from its
reported position (m, map), or the error of the own velocity (m/s, along it), angular velocity (rad/s, body), camera (a
turn of its mounting, rad), focal length (a share, the first entry) or initial position (m, body). The own error depends
on it by a sensitivity Phi, which passes through propagation and correction like the error itself, and an innovation r
of covariance S by M = H Phi + H_f. The sums A of M^T S^-1 M and a of M^T S^-1 r are the information on all faults.

Senders have errors within their covariance without a fault. These are eliminated: with the members' covariance P and
Pi = (P^-1 + A)^-1, the rest for source q is V = A_qq - A_q Pi A_q^T and v = a_q - A_q Pi a. The fault of q is then
f = V^-1 v, and twice the logarithm of its likelihood ratio to none is v^T f. The solution without the source is
x + Phi f with the covariance P + Phi V^-1 Phi^T; it needs no filter of its own.

A sender's reports are also compared with its own odometry. The increment d of a report, which the odometry does not
explain, has the covariance N that fuse_increment derives; a drift gives all increments the same mean.

Protection levels bound the own errors with any single faulty source, at the risk `RISK`. The mixture of likely faults
adds to P. If q is the faulty source, the error is at most |Phi f| and the quantile of the covariance without q. The
level is the largest over all sources that are used, or infinite where the covariance without one of them is too large
to linearise.
Source: Willsky and Jones, A generalized likelihood ratio approach to the detection and estimation of jumps in linear
systems, IEEE Transactions on Automatic Control 21(1), 1976; Blanch et al., Baseline advanced RAIM user algorithm and
possible improvements, IEEE Transactions on Aerospace and Electronic Systems 51(1), 2015, for solution separation and
protection levels.
"""

from statistics import NormalDist
from typing import Any

import warp as wp

from coopenv.estimation.linalg import block3
from coopenv.observers.guard import LATENCY, UNKNOWN
from coopenv.observers.robust import constants
from coopenv.observers.robust.algebra import (
    KNOWN_ANGLE_VARIANCE,
    KNOWN_POSITION_VARIANCE,
    diagonal_by_rows,
    mat33d,
    vec2d,
    vec3d,
    vec6d,
)
from coopenv.observers.robust.memory import ERRORS, FOCAL_ERROR, MOUNTING, SENDER_SLOTS, SOURCES, BearingFrame, fill
from coopenv.observers.robust.sources import (
    CAMERA,
    FOCAL,
    PRIOR,
    VELOCITY,
    clear_drift,
    clear_source,
    guard_factor,
    guarded_covariance,
    is_active,
    is_own,
    is_rejected,
    is_sender,
    note_rejection,
)
from coopenv.world.warp_internals import device_function, subroutine

QUANTILE = NormalDist().inv_cdf(1.0 - 0.5 * constants.RISK)  # of an error along its most uncertain axis


@device_function
def is_evidence(memory: Any, world: int, i: int, n: int) -> bool:
    """Return whether a bearing counts for the monitors: it fits, or the gate rejects many bearings to its source.

    Single outliers are no evidence of a lasting fault.
    """
    fits = memory.measurement[world, i, n].fits
    q = memory.measurement[world, i, n].source
    return fits == 1 or (fits == -1 and q >= 0 and is_rejected(memory, world, i, wp.max(q, 0)))


@device_function
def correct_source(frame: BearingFrame, memory: Any, world: int, i: int, q: int):
    """Add a frame to the vector and the information of a source, and correct its sensitivities."""
    first_sender = memory.belief[world, i].first_sender
    turn = wp.transpose(memory.scratch[world, i, 0].pose.R)
    own = memory.sensitivity[world, i, q, 0]
    errors = memory.sensitivity[world, i, q, ERRORS]
    mounting = memory.sensitivity[world, i, q, MOUNTING]
    vector = memory.source[world, i, q].vector
    A = memory.information[world, i, q, 0]
    for n in range(frame.bearings):
        if is_evidence(memory, world, i, n):
            H = memory.derivative[world, i, n, 0].jacobian
            M = H * own
            if frame.mounting > 0:
                M = M + memory.derivative[world, i, n, 2].jacobian * mounting
            if frame.errors > 0:
                M = M + memory.derivative[world, i, n, 3].jacobian * errors
            if memory.measurement[world, i, n].source == q:
                M = M - H[:, 3:] * turn
            if q == CAMERA:
                M = M + memory.derivative[world, i, n, 2].jacobian[:, :3]
            if q == FOCAL:
                for k in range(2):
                    M[k, 0] = M[k, 0] + memory.derivative[world, i, n, 3].jacobian[k, FOCAL_ERROR]
            if memory.source[world, i, q].map_variance > wp.float64(0.0):  # the errors of all landmarks count
                share = wp.float64(1.0) / memory.source[world, i, q].map_variance
                M = share * memory.map_projection[world, i, n, q - 1 - SENDER_SLOTS]
            WM = memory.measurement[world, i, n].weight * M
            weighted = WM
            if memory.measurement[world, i, n].member > 0:  # errors of messages are the same for that time
                weighted = wp.min(frame.period / wp.float64(constants.NEWS_TIME), wp.float64(1.0)) * WM
            A = A + wp.transpose(weighted) * M
            memory.effect[world, i, n, q] = M
            memory.weighted_effect[world, i, n, q] = weighted
            vector = vector + wp.transpose(weighted) * memory.measurement[world, i, n].innovation
            if memory.measurement[world, i, n].fits == 1:
                own = own - wp.transpose(memory.projection[world, i, n, 0]) * WM
                errors = errors - wp.transpose(memory.projection[world, i, n, ERRORS]) * WM
                if first_sender > MOUNTING:
                    mounting = mounting - wp.transpose(memory.projection[world, i, n, MOUNTING]) * WM
    memory.source[world, i, q].vector = vector
    memory.information[world, i, q, 0] = A
    memory.sensitivity[world, i, q, ERRORS] = errors
    memory.sensitivity[world, i, q, 0] = diagonal_by_rows(memory.scratch[world, i, 0].recentring, own)
    if first_sender > MOUNTING:
        memory.sensitivity[world, i, q, MOUNTING] = diagonal_by_rows(
            memory.scratch[world, i, MOUNTING].recentring, mounting
        )


@device_function
def add_to_drift(memory: Any, world: int, i: int, q: int, d: Any, N: Any):
    """Add the increment d (m, map) of a sender's report, of covariance N, to the sums of its drift."""
    W = wp.inverse(N + wp.float64(constants.MIN_VARIANCE) * wp.identity(3, wp.float64))
    memory.source[world, i, q].drift += d
    memory.source[world, i, q].drift_vector += W * d
    memory.source[world, i, q].drift_information += W


@device_function
def end_drift_block(memory: Any, world: int, i: int, q: int, time: Any, kept: Any):
    """Set the likelihood ratio of a sender's drift, which gives all increments the same mean, at the end of a block.

    A drift begins where the ratio is last as small as without a fault.
    Source: Page, Continuous inspection schemes, Biometrika 41, 1954.
    """
    v = memory.source[world, i, q].drift_vector
    V = memory.source[world, i, q].drift_information
    ratio = wp.dot(v, wp.inverse(V + wp.float64(constants.MIN_VARIANCE) * wp.identity(3, wp.float64)) * v)
    memory.source[world, i, q].drift_ratio = ratio
    if ratio < wp.float64(3.0):
        clear_drift(memory, world, i, q)
    else:
        if ratio > wp.float64(constants.OFFSET_GATE):
            memory.source[world, i, q].drift_time += time
        memory.source[world, i, q].drift_vector = kept * v
        memory.source[world, i, q].drift_information = kept * V


@device_function
def add_information(frame: BearingFrame, memory: Any, world: int, i: int, q: int, c: int):
    """Add the information of a frame on the faults of a source and of a sender."""
    A = memory.information[world, i, q, c]
    for n in range(frame.bearings):
        if is_evidence(memory, world, i, n):
            A = A + wp.transpose(memory.weighted_effect[world, i, n, q]) * memory.effect[world, i, n, c]
    memory.information[world, i, q, c] = A


@subroutine
def correct_sources(frame: BearingFrame, memory: Any, world: int, i: int):
    """Add the innovations of a correction to the information on all faults, and correct the sensitivities."""
    weight = wp.min(frame.period / wp.float64(constants.MEAN_TIME), wp.float64(1.0))
    for q in range(SOURCES):
        if is_active(memory, world, i, q):
            correct_source(frame, memory, world, i, q)
    for q in range(SOURCES):
        if is_active(memory, world, i, q):
            for c in range(1, wp.where(is_sender(q), q, 1 + SENDER_SLOTS)):
                if is_active(memory, world, i, c):
                    add_information(frame, memory, world, i, q, c)
    for q in range(SOURCES):
        memory.source[world, i, q].rejected *= wp.float64(1.0) - weight  # out of view as well
    for n in range(frame.bearings):
        q = memory.measurement[world, i, n].source
        if q >= 0 and memory.measurement[world, i, n].fits == -1:
            note_rejection(memory, world, i, q, weight)
        elif q >= 0 and memory.measurement[world, i, n].fits == 1:
            memory.source[world, i, q].fitted_time += frame.period


@wp.func
def block_between(blocks: Any, q: int, c: int):
    """Return the information on the faults of a source q and a sender c; of two senders, one block is stored."""
    if c == q:
        return blocks[q, 0]
    if is_sender(q) and c > q:
        return wp.transpose(blocks[c, q])
    return blocks[q, c]


@device_function
def invert_blocks(memory: Any, world: int, i: int, n: int):
    """Invert the symmetric positive definite matrix of n x n blocks in `block_scratch` (Gauss-Jordan)."""
    for p in range(n):
        D = wp.inverse(memory.block_scratch[world, i, p, p])
        for j in range(n):
            if j != p:
                memory.block_scratch[world, i, p, j] = D * memory.block_scratch[world, i, p, j]
        for k in range(n):
            if k != p:
                X = memory.block_scratch[world, i, k, p]
                for j in range(n):
                    if j != p:
                        left = memory.block_scratch[world, i, k, j] - X * memory.block_scratch[world, i, p, j]
                        memory.block_scratch[world, i, k, j] = left
                memory.block_scratch[world, i, k, p] = -(X * D)
        memory.block_scratch[world, i, p, p] = D


@device_function
def reported_covariance(memory: Any, world: int, i: int, k: int, j: int):
    """Return the covariance (3, 3), m^2 and map frame, of the reported positions of two members."""
    P = block3(memory.P[world, i, k, j], 3, 3)
    return memory.member[world, i, k].pose.R * P * wp.transpose(memory.member[world, i, j].pose.R)


@device_function
def source_at(memory: Any, world: int, i: int, a: int) -> int:
    """Return the slot of the a-th sender in `block_scratch`."""
    return memory.member[world, i, memory.block_member[world, i, a]].source


@device_function
def eliminate_senders(memory: Any, world: int, i: int, scale: Any) -> int:
    """Set `block_scratch` to Pi, the covariance of the used senders' errors given all innovations; return how many."""
    count = int(0)
    for k in range(memory.belief[world, i].first_sender, memory.belief[world, i].members):
        if is_active(memory, world, i, memory.member[world, i, k].source):
            memory.block_member[world, i, count] = k
            for b in range(count + 1):
                X = scale * reported_covariance(memory, world, i, k, memory.block_member[world, i, b])
                memory.block_scratch[world, i, count, b] = X
                memory.block_scratch[world, i, b, count] = wp.transpose(X)
            count += 1
    invert_blocks(memory, world, i, count)
    for a in range(count):
        for b in range(count):
            q = source_at(memory, world, i, a)
            c = source_at(memory, world, i, b)
            memory.block_scratch[world, i, a, b] += block_between(memory.information[world, i], q, c)
    invert_blocks(memory, world, i, count)
    return count


@device_function
def coupling(memory: Any, world: int, i: int, count: int, q: int, b: int):
    """Return A_q Pi of a source and the b-th sender, 3x3."""
    X = mat33d()
    for a in range(count):
        c = source_at(memory, world, i, a)
        X = X + block_between(memory.information[world, i], q, c) * memory.block_scratch[world, i, a, b]
    return X


@device_function
def restart_fault(memory: Any, world: int, i: int, q: int):
    """Let a fault of the gyro or the camera begin now; a state follows one from further back."""
    clear_source(memory, world, i, q)
    variance = own_fault_variance(memory, world, i, q)
    memory.source[world, i, q].covariance = variance * wp.identity(3, wp.float64)
    memory.source[world, i, q].offset = vec3d()


@subroutine
def end_block(memory: Any, world: int, i: int, time: Any):
    """Add the information of a block of a time, s, on each source's fault to its sums; begin the next block."""
    count = eliminate_senders(memory, world, i, wp.float64(constants.MONITOR_TIME) / time)
    kept = wp.exp(-time / wp.float64(constants.MONITOR_TIME))
    memory.source[world, i, VELOCITY].time += time
    for q in range(SOURCES):
        if is_active(memory, world, i, q):
            V = memory.information[world, i, q, 0]
            v = memory.source[world, i, q].vector
            for b in range(count):
                c = source_at(memory, world, i, b)
                X = coupling(memory, world, i, count, q, b)
                V = V - X * wp.transpose(block_between(memory.information[world, i], q, c))
                v = v - X * memory.source[world, i, c].vector
            V = kept * memory.source[world, i, q].information + wp.float64(0.5) * (V + wp.transpose(V))
            v = kept * memory.source[world, i, q].sum + v
            memory.source[world, i, q].information = V
            memory.source[world, i, q].sum = v
            least = wp.float64(constants.ROUNDING) * wp.trace(V) + wp.float64(constants.MIN_VARIANCE)
            variance = wp.float64(wp.inf)
            if is_own(q):
                variance = own_fault_variance(memory, world, i, q)
                least = wp.float64(1.0) / wp.max(variance, wp.float64(constants.MIN_VARIANCE))
            covariance = wp.inverse(V + least * wp.identity(3, wp.float64))
            if q == VELOCITY:
                speed = memory.belief[world, i].mean_v
                along = speed / wp.max(wp.length(speed), wp.float64(constants.MIN_VELOCITY_STD))
                covariance = wp.outer(along, along) / (wp.dot(along, V * along) + least)
            memory.source[world, i, q].covariance = covariance
            f = covariance * v
            memory.source[world, i, q].offset = f
            memory.source[world, i, q].ratio = wp.dot(v, f)
            if wp.length_sq(f) > wp.float64(QUANTILE * QUANTILE) * variance:
                memory.source[world, i, q].ratio = wp.float64(0.0)
            if is_sender(q):
                end_drift_block(memory, world, i, q, time, kept)
            if q >= CAMERA and memory.source[world, i, q].ratio < wp.float64(constants.OFFSET_GATE):
                restart_fault(memory, world, i, q)
    for q in range(SOURCES):
        if is_active(memory, world, i, q):
            memory.source[world, i, q].vector = vec3d()
            fill(memory.information[world, i, q], mat33d())


@device_function
def own_fault_variance(memory: Any, world: int, i: int, q: int):
    """Return the variance of a fault of the own sensors, see `OWN_FAULT`, or of the initial position, m^2."""
    variance = wp.float64(constants.OWN_FAULT * constants.OWN_FAULT)
    if q == VELOCITY:
        variance = variance * wp.length_sq(memory.belief[world, i].mean_v)
    if q == PRIOR:
        variance = wp.float64(constants.KNOWN_POSITION * constants.KNOWN_POSITION)
    return variance


@wp.func
def own_variances(up: Any, P: Any):
    """Return (2,) sums of horizontal, m^2, and angular variances, rad^2, of a left error of covariance P, 6x6.

    `up` (3,) is the vertical in the body frame.
    """
    variances = vec2d(P[3, 3] + P[4, 4] + P[5, 5], P[0, 0] + P[1, 1] + P[2, 2])
    for i in range(3):
        for j in range(3):
            variances[0] -= up[i] * P[3 + i, 3 + j] * up[j]
    return variances


@wp.func
def levels(up: Any, variances: Any, mean: Any):
    """Return (2,) bounds of horizontal, m, and angular errors, rad: a left error of mean (6,) and variances (2,).

    The sum of variances bounds the variance along any axis.
    """
    shift = vec3d(mean[3], mean[4], mean[5])
    along = wp.dot(up, shift)
    quantile = wp.float64(QUANTILE)
    return vec2d(
        wp.sqrt(wp.max(wp.length_sq(shift) - along * along, wp.float64(0.0)))
        + quantile * wp.sqrt(wp.max(variances[0], wp.float64(0.0))),
        wp.length(vec3d(mean[0], mean[1], mean[2])) + quantile * wp.sqrt(wp.max(variances[1], wp.float64(0.0))),
    )


@subroutine
def protection_level(memory: Any, world: int, i: int):
    """Return (2,) the horizontal, m, and the angular, rad, protection level; infinite: unknown.

    Late frames of all vehicles agree with each other and with odometry, so that no innovation shows them.
    """
    up = wp.transpose(memory.member[world, i, 0].pose.R) * vec3d(wp.float64(0.0), wp.float64(0.0), wp.float64(1.0))
    if guard_factor(memory, world, i) > wp.float64(UNKNOWN):
        return vec2d(wp.float64(wp.inf))
    own = own_variances(up, guarded_covariance(memory, world, i))
    most = levels(up, own, vec6d())
    for q in range(SOURCES):
        if is_active(memory, world, i, q):
            Phi = memory.sensitivity[world, i, q, 0]
            information = wp.trace(memory.source[world, i, q].information)
            # Before its first block, or since an exclusion; gyro and camera have the covariance of a prior then.
            if q < CAMERA and information == wp.float64(0.0) and wp.ddot(Phi, Phi) > wp.float64(0.0):
                return vec2d(wp.float64(wp.inf))
            variances = own + own_variances(up, (Phi * memory.source[world, i, q].covariance) * wp.transpose(Phi))
            if not (
                variances[0] < wp.float64(KNOWN_POSITION_VARIANCE) and variances[1] < wp.float64(KNOWN_ANGLE_VARIANCE)
            ):
                return vec2d(wp.float64(wp.inf))
            most = wp.max(most, levels(up, variances, Phi * memory.source[world, i, q].offset))
    most[0] += wp.float64(LATENCY) * wp.length(memory.belief[world, i].mean_v)
    return most
