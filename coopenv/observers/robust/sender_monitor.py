"""Fault detection and exclusion of senders.

Three tests compare a sender's reports with

- its own odometry: a cumulative sum of the steps that odometry does not explain (drift), and jumps of the odometry;
- all innovations: the error of the sender's position that explains them best;
- single bearings: the share of bearings to the sender that fail the gate.

Bearings reveal that two senders contradict each other. Bearings to landmarks decide which one is wrong, see
solution_separation.py. An excluded sender is tracked by its odometry and by bearings. It is excluded for 1 s at least,
and for twice as long at every further exclusion. The information that the vehicle's own pose owes to the sender is
withdrawn: with errors e = C P_s^-1 e_s + w, a larger P_s inflates the covariance of all errors that depend on e_s.

Innovations. An error of a sender shows in every innovation r of covariance S by M = H_0 C P_s^-1 + H_s. This includes
the part that has passed into the vehicle's own pose. The sums of M^T S^-1 M and M^T S^-1 r are information on that
error. The test fails if the sender's covariance does not allow for it. The correction that a considered sender does not
receive is P_s M^T S^-1 r.
Source: Willsky and Jones, A generalized likelihood ratio approach to the detection and estimation of jumps in linear
systems, IEEE Transactions on Automatic Control 21(1), 1976.

Drift. From report to report a sender moves by its odometry and by a correction x, whose covariance is N = P- - P+. Sums
of x over a time have the sum of the covariances. A drifting position exceeds that, however small its steps are.
Source: the cumulative sum of Page, Continuous inspection schemes, Biometrika 41, 1954, of vectors, with exponential
forgetting.
"""

from typing import Any

import warp as wp

from coopenv.estimation.linalg import block3, symmetric_part
from coopenv.observers.robust import algebra, constants
from coopenv.observers.robust.belief import set_block
from coopenv.observers.robust.memory import (
    BearingFrame,
    Drift,
    PoseEstimate,
    SenderMonitor,
    SenderReport,
    mat33d,
    mat66d,
    vec2d,
    vec3d,
)
from coopenv.observers.robust.tracklets import test_sender
from coopenv.world.warp_internals import device_function

GROSS_VARIANCE = constants.GROSS_ERROR**2


@device_function
def is_excluded(memory: Any, world: int, i: int, sender: int, tick: int) -> bool:
    """Return whether a sender is still excluded by time."""
    return tick < memory.monitor[world, i, sender].excluded_until


@device_function
def inflate_dependents(memory: Any, world: int, i: int, n: int, variance: Any):
    """Add a variance (m^2 per axis) to member n's position, and to all errors that depend on it."""
    members = memory.belief[world, i].members
    inverse = algebra.inverse6(memory.P[world, i, n, n])
    for k in range(members):
        memory.scratch[world, k].column = memory.P[world, i, k, n] * inverse
    for k in range(members):
        A = memory.scratch[world, k].column
        for j in range(k + 1):
            B = memory.scratch[world, j].column
            block = memory.P[world, i, k, j] + variance * (A[:, 3:] * wp.transpose(B[:, 3:]))
            set_block(memory, world, i, k, j, block)


@device_function
def inflate_covariance(memory: Any, world: int, i: int, n: int, variance: Any):
    """Add a variance (m^2 per axis) to member n's position and to dependent errors; if it is large, to the own pose.

    The covariance does not hold how the own pose depends on a gross error: bearings were linearised far from the truth.
    """
    inflate_dependents(memory, world, i, n, variance)
    if variance > wp.float64(GROSS_VARIANCE):
        turn = wp.float64(constants.GROSS_TURN * constants.GROSS_TURN) * variance
        memory.P[world, i, 0, 0] = algebra.with_noise(memory.P[world, i, 0, 0], vec2d(turn, variance))


@device_function
def exclude(model: Any, memory: Any, world: int, i: int, n: int, tick: int, error: Any, fused: bool):
    """Exclude member n, whose position is wrong by `error` (m); `fused`: the own pose has fused that error."""
    sender = memory.member[world, i, n].vehicle
    if fused:
        size = wp.float64(constants.ERROR_FACTOR) * error
        inflate_covariance(memory, world, i, n, size * size)
    memory.P[world, i, n, n] = algebra.with_noise(memory.P[world, i, n, n], vec2d(wp.float64(0.0), error * error))
    memory.member[world, i, n].excluded = 1
    memory.member[world, i, n].considered = 0
    memory.member[world, i, n].agreement_time = wp.float64(0.0)
    monitor = SenderMonitor()
    monitor.exclusions = wp.min(memory.monitor[world, i, sender].exclusions + 1, constants.MAX_EXCLUSIONS)
    monitor.slow_drift = memory.monitor[world, i, sender].slow_drift
    time = wp.float64(constants.AGREEMENT_TIME) * wp.float64(1 << (monitor.exclusions - 1))
    monitor.excluded_until = tick + int(wp.ceil(time / model.camera_period - wp.float64(constants.SAME_TIME)))
    memory.monitor[world, i, sender] = monitor


@device_function
def set_suspect(memory: Any, world: int, i: int, n: int, error: Any, fused: int):
    """Set member n as the frame's suspect, unless there is one: its position seems wrong by `error` (m).

    `fused`: the own pose has fused that error. solution_separation.py decides whether to exclude the suspect.
    """
    if memory.belief[world, i].suspect == 0:
        memory.belief[world, i].suspect = n
        memory.belief[world, i].suspect_error = error
        memory.belief[world, i].suspect_fused = fused


@device_function
def sender_reset_detected(memory: Any, world: int, i: int, n: int, dt: Any) -> bool:
    """Inflate the covariance where member n's new report shows a reset; return whether to replace the old report.

    A reset shows as a covariance that has grown much, or as a jump of the position after a long silence.
    """
    report = memory.member[world, i, n].report
    P = mat66d(report.P)
    before = memory.P[world, i, n, n]
    spread = algebra.position_variance(before)
    grown = algebra.position_variance(P) - spread
    if grown > wp.float64(constants.RESET_GROWTH) * spread:
        inflate_covariance(memory, world, i, n, wp.float64(constants.THIRD) * grown)
    if dt > wp.float64(constants.SILENCE_TIME):
        estimated = PoseEstimate(memory.member[world, i, n].pose, memory.P[world, i, n, n])
        if algebra.distance_squared(estimated, PoseEstimate(report.pose, P)) > wp.float64(constants.STEP_GATE):
            inflate_covariance(memory, world, i, n, wp.length_sq(report.pose.p - memory.member[world, i, n].pose.p))
            return True
    return False


@device_function
def test_report(
    model: Any, memory: Any, world: int, i: int, n: int, tick: int, dt: Any, drift: Any, jumped: bool
) -> bool:
    """Exclude or readmit member n by its new report, dt after the last one; return whether to replace the old report.

    `drift` (m) is the detected drift from its odometry, 0 if there is none; `jumped`: its odometry has jumped.
    """
    report = memory.member[world, i, n].report
    sender = memory.member[world, i, n].vehicle
    if memory.member[world, i, n].excluded == 1:
        test_sender(memory, world, i, n, PoseEstimate(report.pose, mat66d(report.P)), dt)
        if is_excluded(memory, world, i, sender, tick) or drift > wp.float64(0.0):
            memory.member[world, i, n].excluded = 1
            memory.member[world, i, n].agreement_time = wp.float64(0.0)
        return memory.member[world, i, n].excluded == 0
    if sender_reset_detected(memory, world, i, n, dt):
        return True
    test_sender(memory, world, i, n, PoseEstimate(report.pose, mat66d(report.P)), dt)
    if memory.member[world, i, n].excluded == 1 or jumped or drift > wp.float64(0.0):
        drifts = memory.member[world, i, n].excluded == 0 and not jumped
        exclude(model, memory, world, i, n, tick, wp.where(drifts, drift, wp.float64(0.0)), drifts)
        memory.monitor[world, i, sender].self_inconsistent = 1
    return False


@device_function
def reset_monitors(memory: Any, world: int, i: int):
    """Clear the sums over innovations of all senders; they were linearised about a wrong pose."""
    for sender in range(memory.monitor.shape[2]):
        memory.monitor[world, i, sender].information_vector = vec3d()
        memory.monitor[world, i, sender].information_matrix = mat33d()
        memory.monitor[world, i, sender].rejected_share = wp.float64(0.0)
        memory.monitor[world, i, sender].fitted_time = wp.float64(0.0)


@device_function
def average_rejected_share(memory: Any, world: int, i: int, bearings: int, dt: Any) -> bool:
    """Average the share of rejected bearings to each member; return whether bearings to most targets pass the gate.

    Excluded members do not count. If most bearings fail, the own pose may be wrong.
    """
    weight = wp.min(wp.float64(1.0), dt / wp.float64(constants.LOST_TIME))
    balance = int(0)
    for m in range(bearings):
        n = memory.measurement[world, m].member
        fits = memory.measurement[world, m].fits
        if n > 0:
            sender = memory.member[world, i, n].vehicle
            share = memory.monitor[world, i, sender].rejected_share
            share = share + (wp.float64(1 - fits) - share) * weight
            memory.monitor[world, i, sender].rejected_share = share
            memory.monitor[world, i, sender].fitted_time += wp.float64(fits) * dt
            fits = wp.where(share < wp.float64(0.5), 1, 0)
        if n == 0 or memory.member[world, i, n].excluded == 0:
            balance += 2 * fits - 1
    return balance > 0


@device_function
def test_rejected_bearings(memory: Any, world: int, i: int, bearings: int, dt: Any):
    """Set a member as suspect if most bearings to it fail the gate and bearings to most targets pass."""
    if not average_rejected_share(memory, world, i, bearings, dt):
        return
    for m in range(bearings):
        n = memory.measurement[world, m].member
        if n > 0:
            sender = memory.member[world, i, n].vehicle
            rejected = memory.monitor[world, i, sender].rejected_share > wp.float64(constants.LOST_SHARE)
            rejected = rejected and memory.measurement[world, m].fits == 0
            if rejected and memory.member[world, i, n].considered == 1:
                far = wp.length(memory.measurement[world, m].residual) * memory.measurement[world, m].distance
                fitted = memory.monitor[world, i, sender].fitted_time > wp.float64(constants.LOST_TIME)
                set_suspect(memory, world, i, n, far, wp.where(fitted, 1, 0))


@wp.func
def size_squared(x: Any, P: Any):
    """Return the squared size of a vector in standard deviations; 0 where P is no covariance."""
    return wp.max(wp.dot(x, wp.inverse(P) * x), wp.float64(0.0))


@device_function
def information_of(memory: Any, world: int, i: int, sender: int):
    """Return the information on the error of a sender's position, 1/m^2, with a small initial value."""
    V = memory.monitor[world, i, sender].information_matrix
    if wp.trace(V) == wp.float64(0.0):
        V = wp.float64(constants.LEAST_INFORMATION) * wp.identity(3, wp.float64)
    return V


@device_function
def propagate_information(memory: Any, world: int, i: int, sender: int, x: Any, variance: Any):
    """Propagate the information to a sender's new report: correction x (m) after odometry of a variance (m^2)."""
    covariance = wp.inverse(information_of(memory, world, i, sender))
    estimated = covariance * memory.monitor[world, i, sender].information_vector - x
    information = wp.inverse(covariance + variance * wp.identity(3, wp.float64))
    memory.monitor[world, i, sender].information_matrix = information
    memory.monitor[world, i, sender].information_vector = information * estimated


@device_function
def share_of(frame: BearingFrame, memory: Any, world: int, dt: Any):
    """Return the share of a frame's information that counts: noise beyond the camera's is correlated over frames."""
    frames = wp.max(wp.float64(constants.NEWS_TIME) / dt, wp.float64(1.0))
    most = frame.variance
    for m in range(frame.bearings):
        if memory.measurement[world, m].fits == 1:
            lasting = frames * (memory.measurement[world, m].noise - frame.variance)
            most = wp.max(most, frame.variance + lasting)
    return wp.float64(constants.INNOVATION_SUM_SHARE) * frame.variance / most


@device_function
def add_information(memory: Any, world: int, i: int, n: int, bearings: int, share: Any):
    """Add a frame's information on the error of member n's position, along the axes of the map."""
    D = mat33d()
    for m in range(bearings):
        if memory.measurement[world, m].fits == 1:
            g = memory.gain[world, m, n]
            K = memory.measurement[world, m].weight * g
            D = D + wp.transpose(K[:, 3:]) * g[:, 3:]
    R = memory.member[world, i, n].pose.R
    inverse = R * wp.inverse(block3(memory.P[world, i, n, n], 3, 3))
    sender = memory.member[world, i, n].vehicle
    correction = memory.scratch[world, n].full_correction
    information = information_of(memory, world, i, sender) + share * (inverse * D * wp.transpose(inverse))
    vector = memory.monitor[world, i, sender].information_vector + share * (inverse * correction[3:])
    memory.monitor[world, i, sender].information_vector = vector
    memory.monitor[world, i, sender].information_matrix = information


@device_function
def contradiction(memory: Any, world: int, i: int, n: int):
    """Return the squared normalised error of member n that innovations reveal."""
    sender = memory.member[world, i, n].vehicle
    information = information_of(memory, world, i, sender)
    vector = memory.monitor[world, i, sender].information_vector
    covariance = wp.inverse(information)
    R = memory.member[world, i, n].pose.R
    P = R * block3(memory.P[world, i, n, n], 3, 3) * wp.transpose(R)
    return size_squared(covariance * vector, P + covariance)


@device_function
def likely_error(memory: Any, world: int, i: int, n: int):
    """Return the most likely error of member n's position, m, with a prior of 1 m."""
    sender = memory.member[world, i, n].vehicle
    information = information_of(memory, world, i, sender)
    return wp.length(
        wp.inverse(information + wp.identity(3, wp.float64)) * memory.monitor[world, i, sender].information_vector
    )


@device_function
def test_innovations(frame: BearingFrame, memory: Any, world: int, i: int, now: Any):
    """Add a frame's innovations to every considered member's sum; set the member that fails worst as suspect."""
    worst = int(0)
    most = wp.float64(constants.INNOVATION_SUM_GATE)
    share = share_of(frame, memory, world, now.period)
    for n in range(memory.belief[world, i].others, memory.belief[world, i].members):
        if memory.member[world, i, n].considered == 1:
            add_information(memory, world, i, n, frame.bearings, share)
            size = contradiction(memory, world, i, n)
            if size > most:
                worst = n
                most = size
    if worst > 0:
        set_suspect(memory, world, i, worst, likely_error(memory, world, i, worst), 1)


@device_function
def has_jumped(model: Any, memory: Any, world: int, i: int, n: int, step: Any, dt: Any) -> bool:
    """Return whether member n's odometry changes faster than a vehicle can, as with a replayed message."""
    if memory.member[world, i, n].has_twist == 0:
        return False
    q = algebra.odometry_noise(model, i, dt)[1]
    most = wp.float64(0.5 * constants.MAX_SMOOTH_ACCELERATION) * dt * dt
    std = wp.sqrt(memory.member[world, i, n].velocity_variance * dt * dt + q)
    return wp.length(step.p - memory.member[world, i, n].v * dt) > most + wp.float64(constants.JUMP_STD) * std


@wp.func
def summed(drift: Drift, x: Any, N: Any, dt: Any, time: Any):
    """Return a sum with one more step x of covariance N, dt after the last one."""
    share = wp.exp(-dt / time)
    return Drift(share * drift.sum + x, (share * share) * drift.covariance + N)


@device_function
def note_step(memory: Any, world: int, i: int, n: int, last: SenderReport, noise: Any, lasting: Any, dt: Any):
    """Add to member n's sums the step from its propagated last report to its new one; return the step (3,), m, map.

    The sums restart after a long silence or a large growth of the covariance. `noise` and `lasting` are variances
    (rotation, translation) of the odometry, rad^2 and m^2; lasting errors are the same in all steps of a sum.
    """
    sender = memory.member[world, i, n].vehicle
    report = memory.member[world, i, n].report
    step = algebra.between(last.odometry, report.odometry)
    carried = algebra.carried(PoseEstimate(last.pose, mat66d(last.P)), step, noise)
    x = report.pose.p - carried.pose.p
    R = carried.pose.R
    before = block3(carried.P, 3, 3)
    N = before - block3(mat66d(report.P), 3, 3)
    gained = wp.trace(N)
    monitor = memory.monitor[world, i, sender]
    if dt > wp.float64(constants.SILENCE_TIME) or gained < -wp.float64(constants.RESET_GROWTH) * wp.trace(before):
        monitor.drift = Drift()
        monitor.slow_drift = Drift()
    one = wp.identity(3, wp.float64)
    N = symmetric_part(R * N * wp.transpose(R))
    if gained < wp.float64(0.0):
        N = mat33d()
    N = N + wp.float64(constants.SLACK) * noise[1] * one
    same = lasting[1] * one
    fast = N + wp.float64(constants.DRIFT_TIME / constants.ERRORS_TIME) * same
    slow = N + wp.float64(constants.SLOW_DRIFT_TIME / constants.ERRORS_TIME) * same
    monitor.drift = summed(monitor.drift, x, fast, dt, wp.float64(constants.DRIFT_TIME))
    monitor.slow_drift = summed(monitor.slow_drift, x, slow, dt, wp.float64(constants.SLOW_DRIFT_TIME))
    memory.monitor[world, i, sender] = monitor
    return x


@device_function
def drifted(memory: Any, world: int, i: int, sender: int, gate: Any, least: Any):
    """Return a sender's drift from its odometry, m, if it exceeds the gate and `least` (m), else 0."""
    fast = memory.monitor[world, i, sender].drift
    if size_squared(fast.sum, fast.covariance) > gate and wp.length(fast.sum) > least:
        return wp.length(fast.sum)
    slow = memory.monitor[world, i, sender].slow_drift
    if size_squared(slow.sum, slow.covariance) > gate and wp.length(slow.sum) > least:
        return wp.length(slow.sum)
    return wp.float64(0.0)


@device_function
def drift_of(memory: Any, world: int, i: int, n: int):
    """Return member n's drift from its odometry, m, 0 below the gate; the gate of an excluded member is lower."""
    sender = memory.member[world, i, n].vehicle
    if memory.member[world, i, n].excluded == 1:
        return drifted(memory, world, i, sender, wp.float64(constants.DRIFT_CLEAR), wp.float64(0.0))
    P = memory.member[world, i, n].report.P
    std = wp.sqrt(wp.float64(constants.THIRD) * algebra.position_variance(P))
    return drifted(memory, world, i, sender, wp.float64(constants.DRIFT_GATE), wp.float64(constants.DRIFT_STD) * std)
