"""Whose word a vehicle takes: sequential tests of what senders say against their odometry and against bearings.

Three tests run at once. A sender's place against its odometry: between two reports it moves by the odometry and by what
it has learnt, whose covariance is N = P- - P+; the sum of these steps over a time has the sum of the covariances, and a
place that drifts away exceeds it, however small the steps are. Its place against bearings: the filter knows how an error
of a sender would show in every innovation, M = H_0 C P_s^-1 + H_s, what has passed into the vehicle's own pose
included. Sums of M^T S^-1 M and M^T S^-1 r are the information on that error (Willsky and Jones, A generalized likelihood
ratio approach to the detection and estimation of jumps in linear systems, IEEE Transactions on Automatic Control
21(1), 1976), and the error that they tell of contradicts the sender where its covariance has no room for it. Third,
bearings to it do not fit at all while those to others do.

Who is not believed is tracked by odometry and bearings. What the vehicle's own pose owes to that sender becomes
uncertain again: with e = C P_s^-1 e_s + w, a larger P_s enlarges all that depends on it.
"""

from typing import Any

import warp as wp

from coopenv.estimation.linalg import block3
from coopenv.observers.robust import algebra, constants
from coopenv.observers.robust.algebra import with_noise
from coopenv.observers.robust.memory import Estimate, Report, Word, mat33d, mat66d, vec2d, vec3d

GROSS_VARIANCE = constants.GROSS_ERROR**2


@wp.func
def is_barred(memory: Any, world: int, i: int, sender: int, tick: int) -> bool:
    """Return whether a sender is not to be believed yet."""
    return tick < memory.word[world, i, sender].barred_until


@wp.func
def enlarge(memory: Any, world: int, i: int, n: int, variance: Any):
    """Let member n be farther from where it says, by a variance per axis in m^2, with all that depends on its error."""
    members = memory.belief[world, i].members
    inverse = algebra.inverse6(memory.P[world, i, n, n])
    for k in range(members):
        memory.scratch[world, k].column = memory.P[world, i, k, n] * inverse
    for k in range(members):
        A = mat66d(memory.scratch[world, k].column)
        for a in range(6):
            for b in range(3):
                A[a, b] = wp.float64(0.0)
        for j in range(k + 1):
            block = memory.P[world, i, k, j] + variance * (A * wp.transpose(memory.scratch[world, j].column))
            memory.P[world, i, k, j] = block
            memory.P[world, i, j, k] = wp.transpose(block)


@wp.func
def reopen(memory: Any, world: int, i: int, n: int, variance: Any):
    """Let all that depends on what member n said be as uncertain as that is now; where that is much, the own pose."""
    enlarge(memory, world, i, n, variance)
    if variance > wp.float64(GROSS_VARIANCE):
        noise = vec2d(wp.float64(0.01) * variance, variance)
        memory.P[world, i, 0, 0] = with_noise(memory.P[world, i, 0, 0], noise)


@wp.func
def admits(memory: Any, world: int, i: int, n: int, noise: Any, dt: Any) -> bool:
    """Take note where member n's new report admits that what it said before was wrong; return whether it starts anew.

    It does where it knows less than before, and where it has been silent and is elsewhere.
    """
    report = memory.member[world, i, n].report
    P = mat66d(report.P)
    before = memory.P[world, i, n, n]
    spread = before[3, 3] + before[4, 4] + before[5, 5]
    grown = P[3, 3] + P[4, 4] + P[5, 5] - spread
    if grown > wp.float64(0.5) * spread:
        reopen(memory, world, i, n, wp.float64(1.0 / 3.0) * grown)
    if dt > wp.float64(constants.SILENCE):
        believed = Estimate(memory.member[world, i, n].pose, memory.P[world, i, n, n])
        if algebra.distance_squared(believed, Estimate(report.pose, P)) > wp.float64(constants.STEP_GATE):
            x = report.pose.p - memory.member[world, i, n].pose.p
            reopen(memory, world, i, n, wp.length_sq(x))
            return True
    return False


@wp.func
def distrust(model: Any, memory: Any, world: int, i: int, n: int, tick: int, error: Any, far: Any, cause: int):
    """Believe member n no more, which may be off by an error of some metres; every time for longer."""
    sender = memory.member[world, i, n].vehicle
    if error > wp.float64(0.0):
        reopen(memory, world, i, n, error * error)
    if far > wp.float64(0.0):
        memory.P[world, i, n, n] = with_noise(memory.P[world, i, n, n], vec2d(wp.float64(0.0), far * far))
    memory.member[world, i, n].distrusted = 1
    memory.member[world, i, n].considered = 0
    memory.member[world, i, n].agreement_time = wp.float64(0.0)
    offences = wp.min(memory.word[world, i, sender].offences + 1, constants.MAX_OFFENCES)
    word = Word()
    word.offences = offences
    word.causes = memory.word[world, i, sender].causes
    word.causes[cause] = word.causes[cause] + wp.float64(1.0)
    word.slow_drift = memory.word[world, i, sender].slow_drift
    word.slow_spread = memory.word[world, i, sender].slow_spread
    time = wp.float64(constants.AGREEMENT_TIME) * wp.float64(1 << (offences - 1))
    word.barred_until = tick + int(wp.ceil(time / model.camera_period - wp.float64(constants.SAME_TIME)))
    memory.word[world, i, sender] = word


@wp.func
def size_squared(x: Any, P: Any):
    """Return the squared size of a vector in standard deviations; 0 where P is no covariance."""
    size = wp.dot(x, wp.inverse(P) * x)
    return wp.where(size > wp.float64(0.0), size, wp.float64(0.0))


@wp.func
def fading(dt: Any, time: Any):
    """Return the share of a sum that is left after dt."""
    return wp.exp(-dt / time)


@wp.func
def has_jumped(model: Any, memory: Any, world: int, i: int, n: int, step: Any, dt: Any) -> bool:
    """Return whether member n's odometry changes by more than brakes and steering can, as a repeated message's does."""
    if memory.member[world, i, n].has_twist == 0:
        return False
    q = algebra.odometry_noise(model, i, dt)[1]
    most = wp.float64(0.5 * constants.MAX_SMOOTH_ACCELERATION) * dt * dt
    spread = wp.sqrt(memory.member[world, i, n].velocity_variance * dt * dt + q)
    return wp.length(step.p - memory.member[world, i, n].v * dt) > most + wp.float64(4.0) * spread


@wp.func
def certainty_of(memory: Any, world: int, i: int, sender: int):
    """Return the information on how far a sender is from where it says; at first there is hardly any."""
    V = memory.word[world, i, sender].certainty
    if wp.trace(V) == wp.float64(0.0):
        V = wp.float64(constants.LEAST_CERTAINTY) * wp.identity(3, wp.float64)
    return V


@wp.func
def note_step(memory: Any, world: int, i: int, sender: int, last: Report, report: Report, noise: Any, dt: Any):
    """Sum up by how far a sender says to be from where its odometry has led since its last report."""
    step = algebra.between(last.odometry, report.odometry)
    carried = algebra.carried(Estimate(last.pose, mat66d(last.P)), step, noise)
    x = report.pose.p - carried.pose.p
    R = carried.pose.R
    N = R * (block3(carried.P, 3, 3) - block3(mat66d(report.P), 3, 3)) * wp.transpose(R)
    N = wp.float64(0.5) * (N + wp.transpose(N))
    admits = wp.trace(N) < wp.float64(-0.5) * wp.trace(block3(carried.P, 3, 3))
    if wp.trace(N) < wp.float64(0.0):
        N = mat33d()
    N = N + wp.float64(constants.SLACK) * noise[1] * wp.identity(3, wp.float64)
    share = fading(dt, wp.float64(constants.DRIFT_TIME))
    word = memory.word[world, i, sender]
    if admits or dt > wp.float64(constants.SILENCE):
        word.drift = vec3d()
        word.spread = mat33d()
        word.slow_drift = vec3d()
        word.slow_spread = mat33d()
    word.drift = share * word.drift + x
    word.spread = (share * share) * word.spread + N
    share = fading(dt, wp.float64(constants.SLOW_DRIFT_TIME))
    word.slow_drift = share * word.slow_drift + x
    word.slow_spread = (share * share) * word.slow_spread + N
    V = certainty_of(memory, world, i, sender)
    covariance = wp.inverse(V)
    believed = covariance * word.offset - x
    word.certainty = wp.inverse(covariance + noise[1] * wp.identity(3, wp.float64))
    word.offset = word.certainty * believed
    memory.word[world, i, sender] = word


@wp.func
def drifted(memory: Any, world: int, i: int, sender: int, gate: Any):
    """Return how far a sender has drifted from its odometry, in m; 0 if by no more than it may."""
    word = memory.word[world, i, sender]
    if size_squared(word.drift, word.spread) > gate:
        return wp.length(word.drift)
    if size_squared(word.slow_drift, word.slow_spread) > gate:
        return wp.length(word.slow_drift)
    return wp.float64(0.0)


@wp.func
def note_evidence(memory: Any, world: int, i: int, n: int, lines: int, variance: Any, dt: Any):
    """Add what a frame says of how far member n is from where it says.

    Its correction P M^T S^-1 r is not carried out; r has the covariance S.
    """
    D = mat33d()
    for m in range(lines):
        if memory.line[world, m].fits == 1:
            g = memory.gain[world, m, n]
            K = memory.line[world, m].weight * g
            D = D + wp.transpose(K[:, 3:]) * g[:, 3:]
    R = memory.member[world, i, n].pose.R
    inverse = R * wp.inverse(block3(memory.P[world, i, n, n], 3, 3))
    sender = memory.member[world, i, n].vehicle
    share = fading(dt, wp.float64(constants.EVIDENCE_TIME))
    share = wp.float64(1.0)
    f = wp.float64(constants.EVIDENCE_SHARE)
    for m in range(lines):
        if memory.line[world, m].fits == 1:
            lasting = wp.max(wp.float64(constants.NEWS_TIME) / dt, wp.float64(1.0)) * (memory.line[world, m].noise - variance)
            f = wp.min(f, wp.float64(constants.EVIDENCE_SHARE) * variance / (variance + lasting))
    c = memory.scratch[world, n].wish
    offset = share * memory.word[world, i, sender].offset + f * (inverse * c[3:])
    certainty = share * certainty_of(memory, world, i, sender) + f * inverse * D * wp.transpose(inverse)
    memory.word[world, i, sender].offset = offset
    memory.word[world, i, sender].certainty = certainty


@wp.func
def contradiction(memory: Any, world: int, i: int, n: int):
    """Return by how much bearings contradict member n, squared in standard deviations, and by how many metres."""
    sender = memory.member[world, i, n].vehicle
    covariance = wp.inverse(certainty_of(memory, world, i, sender))
    b = covariance * memory.word[world, i, sender].offset
    R = memory.member[world, i, n].pose.R
    P = R * block3(memory.P[world, i, n, n], 3, 3) * wp.transpose(R)
    likely = wp.inverse(certainty_of(memory, world, i, sender) + wp.identity(3, wp.float64)) * memory.word[world, i, sender].offset
    return size_squared(b, P + covariance), wp.length(likely)


@wp.func
def test_words(model: Any, memory: Any, world: int, i: int, lines: int, variance: Any, tick: int, dt: Any):
    """Weigh a frame's bearings against what every member says; believe the one no more that they contradict most."""
    worst = int(0)
    most = wp.float64(constants.WORD_GATE)
    error = wp.float64(0.0)
    for n in range(memory.belief[world, i].others, memory.belief[world, i].members):
        if memory.member[world, i, n].considered == 1:
            note_evidence(memory, world, i, n, lines, variance, dt)
            size, far = contradiction(memory, world, i, n)
            if size > most:
                worst = n
                most = size
                error = far
    if worst > 0:
        distrust(model, memory, world, i, worst, tick, wp.float64(constants.ERROR_FACTOR) * error, error, 0)


@wp.func
def test_missed(model: Any, memory: Any, world: int, i: int, lines: int, dt: Any, healthy: bool, tick: int):
    """Average which share of the bearings to each member do not fit; believe those no more to which most do not."""
    weight = wp.min(wp.float64(1.0), dt / wp.float64(constants.LOST_TIME))
    for m in range(lines):
        n = memory.line[world, m].member
        if n > 0:
            sender = memory.member[world, i, n].vehicle
            share = memory.word[world, i, sender].missed_share
            missed = wp.float64(1 - memory.line[world, m].fits)
            share = share + (missed - share) * weight
            memory.word[world, i, sender].missed_share = share
            memory.word[world, i, sender].fitted_time += (wp.float64(1.0) - missed) * dt
            if healthy and memory.member[world, i, n].considered == 1 and share > wp.float64(constants.LOST_SHARE):
                far = wp.length(memory.line[world, m].residual) * memory.line[world, m].distance
                error = wp.float64(constants.ERROR_FACTOR) * far + wp.float64(constants.AGREEMENT_DISTANCE)
                if memory.word[world, i, sender].fitted_time < wp.float64(constants.LOST_TIME):
                    error = wp.float64(0.0)
                distrust(model, memory, world, i, n, tick, error, wp.float64(constants.ERROR_FACTOR) * far, 1)
