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
from coopenv.observers.robust.memory import Drift, Estimate, Frame, Report, Word, mat33d, mat66d, vec2d, vec3d
from coopenv.observers.robust.tracklets import test_sender
from coopenv.world.warp_internals import device_function

GROSS_VARIANCE = constants.GROSS_ERROR**2


@device_function
def is_barred(memory: Any, world: int, i: int, sender: int, tick: int) -> bool:
    """Return whether a sender is not to be believed yet."""
    return tick < memory.word[world, i, sender].barred_until


@wp.func
def only_position(M: Any):
    """Return a 6x6 matrix without its first three columns."""
    result = mat66d(M)
    for a in range(6):
        for b in range(3):
            result[a, b] = wp.float64(0.0)
    return result


@device_function
def enlarge(memory: Any, world: int, i: int, n: int, variance: Any):
    """Let member n be farther from where it says, by a variance per axis in m^2, with all that depends on its error."""
    members = memory.belief[world, i].members
    inverse = algebra.inverse6(memory.P[world, i, n, n])
    for k in range(members):
        memory.scratch[world, k].column = memory.P[world, i, k, n] * inverse
    for k in range(members):
        A = only_position(memory.scratch[world, k].column)
        for j in range(k + 1):
            block = memory.P[world, i, k, j] + variance * (A * wp.transpose(memory.scratch[world, j].column))
            memory.P[world, i, k, j] = block
            memory.P[world, i, j, k] = wp.transpose(block)


@device_function
def reopen(memory: Any, world: int, i: int, n: int, variance: Any):
    """Let all that depends on what member n said be as uncertain as that is now; where that is much, the own pose.

    It depends on a gross error in ways that no covariance tells, because lines of sight were linearised far away.
    """
    enlarge(memory, world, i, n, variance)
    if variance > wp.float64(GROSS_VARIANCE):
        turn = wp.float64(constants.GROSS_TURN * constants.GROSS_TURN) * variance
        memory.P[world, i, 0, 0] = algebra.with_noise(memory.P[world, i, 0, 0], vec2d(turn, variance))


@device_function
def distrust(model: Any, memory: Any, world: int, i: int, n: int, tick: int, error: Any, believed: bool):
    """Believe member n no more, which is off by some metres; `believed`: the own pose has followed that error."""
    sender = memory.member[world, i, n].vehicle
    if believed:
        size = wp.float64(constants.ERROR_FACTOR) * error
        reopen(memory, world, i, n, size * size)
    memory.P[world, i, n, n] = algebra.with_noise(memory.P[world, i, n, n], vec2d(wp.float64(0.0), error * error))
    memory.member[world, i, n].distrusted = 1
    memory.member[world, i, n].considered = 0
    memory.member[world, i, n].agreement_time = wp.float64(0.0)
    word = Word()
    word.offences = wp.min(memory.word[world, i, sender].offences + 1, constants.MAX_OFFENCES)
    word.slow_drift = memory.word[world, i, sender].slow_drift
    time = wp.float64(constants.AGREEMENT_TIME) * wp.float64(1 << (word.offences - 1))
    word.barred_until = tick + int(wp.ceil(time / model.camera_period - wp.float64(constants.SAME_TIME)))
    memory.word[world, i, sender] = word


@device_function
def accuse(memory: Any, world: int, i: int, n: int, error: Any, followed: int):
    """Say that bearings contradict member n, if they do no other: it is off by some metres.

    `followed`: the own pose has followed that error. solution_separation.py decides on it.
    """
    if memory.belief[world, i].accused == 0:
        memory.belief[world, i].accused = n
        memory.belief[world, i].accused_error = error
        memory.belief[world, i].accused_followed = followed


@device_function
def admits(memory: Any, world: int, i: int, n: int, dt: Any) -> bool:
    """Take note where member n's new report admits that what it said before was wrong; return whether it starts anew.

    It does where it knows much less than before, and where it has been silent for long and is elsewhere.
    """
    report = memory.member[world, i, n].report
    P = mat66d(report.P)
    before = memory.P[world, i, n, n]
    spread = algebra.position_variance(before)
    grown = algebra.position_variance(P) - spread
    if grown > wp.float64(constants.ADMISSION) * spread:
        reopen(memory, world, i, n, wp.float64(constants.THIRD) * grown)
    if dt > wp.float64(constants.SILENCE_TIME):
        believed = Estimate(memory.member[world, i, n].pose, memory.P[world, i, n, n])
        if algebra.distance_squared(believed, Estimate(report.pose, P)) > wp.float64(constants.STEP_GATE):
            reopen(memory, world, i, n, wp.length_sq(report.pose.p - memory.member[world, i, n].pose.p))
            return True
    return False


@device_function
def judge(model: Any, memory: Any, world: int, i: int, n: int, tick: int, dt: Any, drift: Any, jumped: bool) -> bool:
    """Decide whether member n is believed, from its new report, dt after the last one; return whether it starts anew.

    It has drifted from its odometry by `drift` (m; 0 if by no more than it may), or its odometry has jumped.
    """
    report = memory.member[world, i, n].report
    sender = memory.member[world, i, n].vehicle
    if memory.member[world, i, n].distrusted == 1:
        test_sender(memory, world, i, n, Estimate(report.pose, mat66d(report.P)), dt)
        if is_barred(memory, world, i, sender, tick) or drift > wp.float64(0.0):
            memory.member[world, i, n].distrusted = 1
            memory.member[world, i, n].agreement_time = wp.float64(0.0)
        return memory.member[world, i, n].distrusted == 0
    if admits(memory, world, i, n, dt):
        return True
    test_sender(memory, world, i, n, Estimate(report.pose, mat66d(report.P)), dt)
    if jumped or memory.member[world, i, n].distrusted == 1:
        distrust(model, memory, world, i, n, tick, wp.float64(0.0), False)
        memory.word[world, i, sender].perjured = 1
    elif drift > wp.float64(0.0):
        distrust(model, memory, world, i, n, tick, drift, True)
        memory.word[world, i, sender].perjured = 1
    return False


@device_function
def forget_evidence(memory: Any, world: int, i: int):
    """Forget what bearings have said of others: they were taken from where the vehicle is not."""
    for sender in range(memory.word.shape[2]):
        memory.word[world, i, sender].offset = vec3d()
        memory.word[world, i, sender].certainty = mat33d()
        memory.word[world, i, sender].missed_share = wp.float64(0.0)
        memory.word[world, i, sender].fitted_time = wp.float64(0.0)


@device_function
def note_missed(memory: Any, world: int, i: int, lines: int, dt: Any) -> bool:
    """Average which share of the bearings to each member do not fit; return whether those to most targets fit.

    Distrusted members do not count. Where most do not fit it may be the vehicle itself that is lost.
    """
    weight = wp.min(wp.float64(1.0), dt / wp.float64(constants.LOST_TIME))
    balance = int(0)
    for m in range(lines):
        n = memory.line[world, m].member
        fits = memory.line[world, m].fits
        if n > 0:
            sender = memory.member[world, i, n].vehicle
            share = memory.word[world, i, sender].missed_share
            share = share + (wp.float64(1 - fits) - share) * weight
            memory.word[world, i, sender].missed_share = share
            memory.word[world, i, sender].fitted_time += wp.float64(fits) * dt
            fits = wp.where(share < wp.float64(0.5), 1, 0)
        if n == 0 or memory.member[world, i, n].distrusted == 0:
            balance += 2 * fits - 1
    return balance > 0


@device_function
def test_missed(memory: Any, world: int, i: int, lines: int, dt: Any):
    """Accuse a member to which most bearings do not fit, while those to most targets do."""
    if not note_missed(memory, world, i, lines, dt):
        return
    for m in range(lines):
        n = memory.line[world, m].member
        if n > 0:
            sender = memory.member[world, i, n].vehicle
            missed = memory.word[world, i, sender].missed_share > wp.float64(constants.LOST_SHARE)
            missed = missed and memory.line[world, m].fits == 0
            if missed and memory.member[world, i, n].considered == 1:
                far = wp.length(memory.line[world, m].residual) * memory.line[world, m].distance
                fitted = memory.word[world, i, sender].fitted_time > wp.float64(constants.LOST_TIME)
                accuse(memory, world, i, n, far, wp.where(fitted, 1, 0))


@wp.func
def size_squared(x: Any, P: Any):
    """Return the squared size of a vector in standard deviations; 0 where P is no covariance."""
    return wp.max(wp.dot(x, wp.inverse(P) * x), wp.float64(0.0))


@device_function
def certainty_of(memory: Any, world: int, i: int, sender: int):
    """Return the information on how far a sender is from where it says, 1/m^2; at first there is hardly any."""
    V = memory.word[world, i, sender].certainty
    if wp.trace(V) == wp.float64(0.0):
        V = wp.float64(constants.LEAST_CERTAINTY) * wp.identity(3, wp.float64)
    return V


@device_function
def carry_evidence(memory: Any, world: int, i: int, sender: int, x: Any, variance: Any):
    """Let evidence be about where a sender says to be now: x (m) from where odometry of a variance (m^2) has led."""
    covariance = wp.inverse(certainty_of(memory, world, i, sender))
    believed = covariance * memory.word[world, i, sender].offset - x
    certainty = wp.inverse(covariance + variance * wp.identity(3, wp.float64))
    memory.word[world, i, sender].certainty = certainty
    memory.word[world, i, sender].offset = certainty * believed


@device_function
def share_of(frame: Frame, memory: Any, world: int, dt: Any):
    """Return which share of a frame's information counts: noise that is not the camera's lasts for many frames."""
    frames = wp.max(wp.float64(constants.NEWS_TIME) / dt, wp.float64(1.0))
    most = frame.variance
    for m in range(frame.lines):
        if memory.line[world, m].fits == 1:
            lasting = frames * (memory.line[world, m].noise - frame.variance)
            most = wp.max(most, frame.variance + lasting)
    return wp.float64(constants.EVIDENCE_SHARE) * frame.variance / most


@device_function
def note_evidence(memory: Any, world: int, i: int, n: int, lines: int, share: Any):
    """Add what a frame says of how far member n is from where it says, along the axes of the map."""
    D = mat33d()
    for m in range(lines):
        if memory.line[world, m].fits == 1:
            g = memory.gain[world, m, n]
            K = memory.line[world, m].weight * g
            D = D + wp.transpose(K[:, 3:]) * g[:, 3:]
    R = memory.member[world, i, n].pose.R
    inverse = R * wp.inverse(block3(memory.P[world, i, n, n], 3, 3))
    sender = memory.member[world, i, n].vehicle
    correction = memory.scratch[world, n].full_correction
    certainty = certainty_of(memory, world, i, sender) + share * (inverse * D * wp.transpose(inverse))
    offset = memory.word[world, i, sender].offset + share * (inverse * correction[3:])
    memory.word[world, i, sender].offset = offset
    memory.word[world, i, sender].certainty = certainty


@device_function
def contradiction(memory: Any, world: int, i: int, n: int):
    """Return by how much bearings contradict member n, squared in standard deviations."""
    sender = memory.member[world, i, n].vehicle
    certainty = certainty_of(memory, world, i, sender)
    offset = memory.word[world, i, sender].offset
    covariance = wp.inverse(certainty)
    R = memory.member[world, i, n].pose.R
    P = R * block3(memory.P[world, i, n, n], 3, 3) * wp.transpose(R)
    return size_squared(covariance * offset, P + covariance)


@device_function
def likely_error(memory: Any, world: int, i: int, n: int):
    """Return how far member n is likely to be from where it says, m: some metre at most, unless bearings tell."""
    sender = memory.member[world, i, n].vehicle
    certainty = certainty_of(memory, world, i, sender)
    return wp.length(wp.inverse(certainty + wp.identity(3, wp.float64)) * memory.word[world, i, sender].offset)


@device_function
def test_words(frame: Frame, memory: Any, world: int, i: int, now: Any):
    """Weigh a frame's bearings against what every member says; accuse the one that they contradict most."""
    worst = int(0)
    most = wp.float64(constants.WORD_GATE)
    share = share_of(frame, memory, world, now.period)
    for n in range(memory.belief[world, i].others, memory.belief[world, i].members):
        if memory.member[world, i, n].considered == 1:
            note_evidence(memory, world, i, n, frame.lines, share)
            size = contradiction(memory, world, i, n)
            if size > most:
                worst = n
                most = size
    if worst > 0:
        accuse(memory, world, i, worst, likely_error(memory, world, i, worst), 1)


@device_function
def has_jumped(model: Any, memory: Any, world: int, i: int, n: int, step: Any, dt: Any) -> bool:
    """Return whether member n's odometry changes by more than brakes and steering can, as a repeated message's does."""
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
def note_step(
    memory: Any, world: int, i: int, sender: int, last: Report, report: Report, noise: Any, lasting: Any, dt: Any
):
    """Sum up by how far a sender says to be from where its odometry has led since its last report.

    Who has been silent for long, or knows much less than before, may be anywhere. `noise` and `lasting` are variances
    (rotation, translation) of the odometry, rad^2 and m^2; errors that last are the same in all steps of a sum.
    Return how far (3,), m, in the map.
    """
    step = algebra.between(last.odometry, report.odometry)
    carried = algebra.carried(Estimate(last.pose, mat66d(last.P)), step, noise)
    x = report.pose.p - carried.pose.p
    R = carried.pose.R
    before = block3(carried.P, 3, 3)
    N = before - block3(mat66d(report.P), 3, 3)
    gained = wp.trace(N)
    word = memory.word[world, i, sender]
    if dt > wp.float64(constants.SILENCE_TIME) or gained < -wp.float64(constants.ADMISSION) * wp.trace(before):
        word.drift = Drift()
        word.slow_drift = Drift()
    one = wp.identity(3, wp.float64)
    N = symmetric_part(R * N * wp.transpose(R))
    if gained < wp.float64(0.0):
        N = mat33d()
    N = N + wp.float64(constants.SLACK) * noise[1] * one
    same = lasting[1] * one
    fast = N + wp.float64(constants.DRIFT_TIME / constants.ERRORS_TIME) * same
    slow = N + wp.float64(constants.SLOW_DRIFT_TIME / constants.ERRORS_TIME) * same
    word.drift = summed(word.drift, x, fast, dt, wp.float64(constants.DRIFT_TIME))
    word.slow_drift = summed(word.slow_drift, x, slow, dt, wp.float64(constants.SLOW_DRIFT_TIME))
    memory.word[world, i, sender] = word
    return x


@device_function
def drifted(memory: Any, world: int, i: int, sender: int, gate: Any, least: Any):
    """Return how far a sender has drifted from its odometry, in m, if by more than it may and by `least`, else 0."""
    fast = memory.word[world, i, sender].drift
    if size_squared(fast.sum, fast.covariance) > gate and wp.length(fast.sum) > least:
        return wp.length(fast.sum)
    slow = memory.word[world, i, sender].slow_drift
    if size_squared(slow.sum, slow.covariance) > gate and wp.length(slow.sum) > least:
        return wp.length(slow.sum)
    return wp.float64(0.0)


@device_function
def drift_of(memory: Any, world: int, i: int, n: int):
    """Return how far member n has drifted from its odometry, in m; 0 if by no more than it may, distrusted by less."""
    sender = memory.member[world, i, n].vehicle
    if memory.member[world, i, n].distrusted == 1:
        return drifted(memory, world, i, sender, wp.float64(constants.DRIFT_CLEAR), wp.float64(0.0))
    P = memory.member[world, i, n].report.P
    std = wp.sqrt(wp.float64(constants.THIRD) * algebra.position_variance(P))
    return drifted(memory, world, i, sender, wp.float64(constants.DRIFT_GATE), wp.float64(constants.DRIFT_STD) * std)
