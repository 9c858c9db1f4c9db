"""Whom a vehicle believes, and what follows when it believes somebody no more.

Tests of a sender's word are in drift.py (its place against its odometry), in evidence.py (against bearings, slowly) and
here (bearings to it that do not fit at all). Bearings tell that two contradict each other; which of them is wrong tell
those to landmarks, see told/separation.py. Who is not believed is tracked by its odometry and by bearings, for a
second at least, and twice as long every further time. What the vehicle's own pose owes to that sender becomes uncertain
again: with errors e = C P_s^-1 e_s + w, a larger P_s enlarges all that depends on it.
"""

from typing import Any

import warp as wp

from coopenv.observers.robust import algebra, constants
from coopenv.observers.robust.memory import Estimate, Word, mat33d, mat66d, vec2d, vec3d
from coopenv.observers.robust.tracklets import test_sender
from coopenv.world.device_function import device_function

GROSS_VARIANCE = constants.GROSS_ERROR**2
THIRD = 1.0 / 3.0


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

    `followed`: the own pose has followed that error. What becomes of it is told/separation.py's.
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
        reopen(memory, world, i, n, wp.float64(THIRD) * grown)
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
