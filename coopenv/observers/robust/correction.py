"""The iterated correction of the belief by a frame's bearings."""

from typing import Any

import warp as wp

from coopenv.observers.robust import constants
from coopenv.observers.robust.algebra import by_rows, displaced, is_known, mat66d, recentring, transposed_by_rows, vec6d
from coopenv.observers.robust.joint_state import apply_corrections, set_block
from coopenv.observers.robust.linearisation import innovation_cross_covariance, innovation_weight, linearise, project
from coopenv.observers.robust.memory import DERIVATIVES, ERRORS, LANDMARK_SLOTS, BearingFrame
from coopenv.world.warp_internals import device_function, subroutine


@device_function
def linearise_again(frame: BearingFrame, memory: Any, world: int, i: int, share: Any):
    """Linearise the bearings after a share of the correction, in errors about the poses before the correction.

    Considered members stay.
    """
    estimated = memory.belief[world, i].first_sender
    for k in range(estimated):
        correction = share * memory.scratch[world, i, k].correction
        memory.scratch[world, i, k].last_correction = correction
        memory.scratch[world, i, k].recentring = recentring(correction)
        memory.member[world, i, k].pose = displaced(memory.scratch[world, i, k].pose, correction)
    for n in range(frame.bearings):
        if memory.measurement[world, i, n].fits != 0:
            linearise(frame, memory, world, i, n)
            for part in range(DERIVATIVES):
                member = memory.derivative[world, i, n, part].member
                if member >= 0 and member < estimated and member != ERRORS:
                    G = memory.scratch[world, i, member].recentring
                    memory.derivative[world, i, n, part].jacobian = by_rows(
                        memory.derivative[world, i, n, part].jacobian, G
                    )


@device_function
def set_projection(memory: Any, world: int, i: int, n: int):
    """Set a bearing's `projection` H P, with P after the earlier bearings, and its `weight` S^-1."""
    members = memory.belief[world, i].members
    for m in range(n):
        if memory.measurement[world, i, m].fits == 1:
            share = innovation_cross_covariance(memory, world, i, n, m) * memory.measurement[world, i, m].weight
            for k in range(members):
                memory.projection[world, i, n, k] = (
                    memory.projection[world, i, n, k] - share * memory.projection[world, i, m, k]
                )
            if memory.belief[world, i].map_errors == 1:
                for slot in range(LANDMARK_SLOTS):
                    left = memory.map_projection[world, i, n, slot] - share * memory.map_projection[world, i, m, slot]
                    memory.map_projection[world, i, n, slot] = left
    memory.measurement[world, i, n].weight = innovation_weight(
        memory, world, i, n, memory.measurement[world, i, n].noise
    )


@subroutine
def correct_by_bearings(memory: Any, world: int, i: int, bearings: int, projecting: bool):
    """Find the correction by all bearings that fit, without a change of the covariance.

    A sequential update with the residuals that the earlier bearings leave equals the batch update. Rejected bearings
    correct nothing; the monitors limit their innovation. Considered members are not corrected.

    Returns:
        The largest NIS of a bearing that fits, given the earlier ones, and the sum of all.
    """
    members = memory.belief[world, i].members
    most = wp.float64(0.0)
    total = wp.float64(0.0)
    for k in range(members):
        memory.scratch[world, i, k].correction = vec6d()
    for n in range(bearings):
        if memory.measurement[world, i, n].fits != 0:
            if projecting:
                project(memory, world, i, n)
            set_projection(memory, world, i, n)
            residual = memory.measurement[world, i, n].residual
            for part in range(DERIVATIVES):
                k = memory.derivative[world, i, n, part].member
                if k >= 0:
                    left = -memory.scratch[world, i, k].correction
                    if k != ERRORS:  # which are not moved before the end, as bearings are linear in them
                        left = left + memory.scratch[world, i, k].last_correction
                    residual = residual + memory.derivative[world, i, n, part].jacobian * left
            weighted = memory.measurement[world, i, n].weight * residual
            nis = wp.dot(weighted, residual)
            if memory.measurement[world, i, n].fits == -1:
                residual = residual * wp.sqrt(wp.min(wp.float64(constants.MAX_EVIDENCE) / nis, wp.float64(1.0)))
            memory.measurement[world, i, n].innovation = residual
            if memory.measurement[world, i, n].fits == 1:
                most = wp.max(most, nis)
                total += nis
                for k in range(members):
                    correction = memory.scratch[world, i, k].correction + weighted * memory.projection[world, i, n, k]
                    memory.scratch[world, i, k].correction = correction
    for k in range(memory.belief[world, i].first_sender, members):
        memory.scratch[world, i, k].correction = vec6d()
    return most, total


@subroutine
def gate_jointly(memory: Any, world: int, i: int, bearings: int):
    """Reject, one by one, the bearing without which the others fit best, until each fits given the earlier ones.

    Source: Parkinson and Axelrad, Autonomous GPS integrity monitoring using the pseudorange residual, Navigation 35(2),
    1988, for the exclusion by the residuals of subsets.
    """
    most, total = correct_by_bearings(memory, world, i, bearings, False)
    while most > wp.float64(constants.BEARING_GATE):
        least = wp.float64(wp.inf)
        worst = int(-1)
        for n in range(bearings):
            if memory.measurement[world, i, n].fits == 1:
                memory.measurement[world, i, n].fits = -1
                most, total = correct_by_bearings(memory, world, i, bearings, True)
                memory.measurement[world, i, n].fits = 1
                if total < least:
                    least = total
                    worst = n
        if worst < 0:  # no sum is a number: the estimate is not valid
            return
        memory.measurement[world, i, worst].fits = -1
        most, total = correct_by_bearings(memory, world, i, bearings, True)


@subroutine
def update_covariance(memory: Any, world: int, i: int, bearings: int):
    """Update the covariance by the bearings that fit; the covariance of considered errors stays."""
    for k in range(memory.belief[world, i].first_sender):
        for j in range(k, memory.belief[world, i].members):
            block = mat66d()
            for n in range(bearings):
                if memory.measurement[world, i, n].fits != 1:
                    continue
                K = memory.measurement[world, i, n].weight * memory.projection[world, i, n, k]
                block = block + transposed_by_rows(K, memory.projection[world, i, n, j])
            set_block(memory, world, i, k, j, memory.P[world, i, k, j] - block)


@device_function
def turn_of_sight(memory: Any, world: int, i: int, bearings: int, share: Any, last: Any):
    """Return the largest turn (rad) of a line of sight by a share of the correction less one of the last correction."""
    distance = wp.float64(wp.inf)  # of the nearest target
    for n in range(bearings):
        if memory.measurement[world, i, n].fits == 1:
            distance = wp.min(distance, memory.measurement[world, i, n].distance)
    turn = wp.float64(0.0)
    for k in range(memory.belief[world, i].first_sender):
        further = share * memory.scratch[world, i, k].correction - last * memory.scratch[world, i, k].last_correction
        size = wp.abs(further)
        turn = wp.max(turn, wp.max(wp.max(size[:3]), wp.max(size[3:]) / distance))
    return turn


@device_function
def is_to_landmarks(memory: Any, world: int, i: int, bearings: int) -> bool:
    """Return whether no bearing that fits is one to a vehicle."""
    for n in range(bearings):
        if memory.measurement[world, i, n].fits == 1 and memory.measurement[world, i, n].member > 0:
            return False
    return True


@device_function
def next_share(memory: Any, world: int, i: int, bearings: int, first: bool):
    """Return the share of the correction at which to linearise next, 0 if that is near the last linearisation point.

    The share is 1 if the correction turns a line of sight far, else 0.5; 0 if it turns none noticeably and vehicles,
    whose range would be biased, are none of the targets.
    """
    one = wp.float64(1.0)
    turn = turn_of_sight(memory, world, i, bearings, one, wp.float64(0.0))
    share = wp.where(turn >= wp.float64(constants.LINEAR_ANGLE), one, wp.float64(0.5))
    if first:
        if turn < wp.float64(constants.NOTICEABLE_TURN) and is_to_landmarks(memory, world, i, bearings):
            share = wp.float64(0.0)
    else:
        if turn_of_sight(memory, world, i, bearings, share, one) < wp.float64(constants.LINEAR_ANGLE):
            share = wp.float64(0.0)
    return share


@device_function
def gate_is_open(memory: Any, world: int, i: int) -> bool:
    """Return whether the gate is open: bearings that fail it count, too, while most fail and no search has begun."""
    return memory.belief[world, i].lost_time > wp.float64(0.0) and memory.search[world, i].active == 0


@subroutine
def iterated_update(frame: BearingFrame, memory: Any, world: int, i: int):
    """Correct by the bearings that fit, linearised at half of a small correction, or after all of a large one.

    A correction by landmarks alone that turns no line of sight by `NOTICEABLE_TURN` is applied as it is.

    For a large correction these are Gauss-Newton steps. For a small one, gain and innovation depend on the same noise:
    two vehicles with little relative motion estimate their range with a bias. The point of linearisation changes it
    little beside the linearisation variance (`python -m benchmarks.linearisation_point`), but half way the errors at
    road speed are smaller than at the prediction.
    Source: Bell and Cathey, The iterated Kalman filter update as a Gauss-Newton method, IEEE Transactions on Automatic
    Control 38(2), 1993.
    """
    bearings = frame.bearings
    for k in range(memory.belief[world, i].members):
        memory.scratch[world, i, k].last_correction = vec6d()
        memory.scratch[world, i, k].pose = memory.member[world, i, k].pose
    if is_known(memory.P[world, i, 0, 0]) and not gate_is_open(memory, world, i):
        gate_jointly(memory, world, i, bearings)
    else:  # innovations after the first one are not linear enough to reject any
        correct_by_bearings(memory, world, i, bearings, False)
    share = next_share(memory, world, i, bearings, True)
    step = int(1)
    while share > wp.float64(0.0) and step < constants.MAX_ITERATIONS:
        linearise_again(frame, memory, world, i, share)
        correct_by_bearings(memory, world, i, bearings, True)
        share = next_share(memory, world, i, bearings, False)
        step += 1
    for k in range(memory.belief[world, i].members):
        memory.member[world, i, k].pose = memory.scratch[world, i, k].pose
    update_covariance(memory, world, i, bearings)
    apply_corrections(memory, world, i)
