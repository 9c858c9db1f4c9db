"""A sender's place against its odometry: it may leave where that leads as far as it has learnt, and no farther.

From report to report it moves by its odometry and by what it has learnt, x, whose covariance is N = P- - P+. Sums of x
over a time have the sum of the covariances. A place that drifts away exceeds that, however small its steps are: a
cumulative sum (Page, Continuous inspection schemes, Biometrika 41, 1954) of vectors, that forgets exponentially.
"""

from typing import Any

import warp as wp

from coopenv.estimation.linalg import block3, symmetric_part
from coopenv.observers.robust import algebra, constants
from coopenv.observers.robust.evidence import size_squared
from coopenv.observers.robust.memory import Drift, Estimate, Report, mat33d, mat66d
from coopenv.world.device_function import device_function

THIRD = 1.0 / 3.0


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
    std = wp.sqrt(wp.float64(THIRD) * algebra.position_variance(P))
    return drifted(memory, world, i, sender, wp.float64(constants.DRIFT_GATE), wp.float64(constants.DRIFT_STD) * std)
