"""The correction of the belief by a frame's bearings."""

from typing import Any

import warp as wp

from coopenv.observers.robust.algebra import displaced, recentring
from coopenv.observers.robust.belief import apply_corrections, subtract_block
from coopenv.observers.robust.constants import MAX_LINEARISATIONS, RELINEARISATION_ANGLE
from coopenv.observers.robust.measurements import linearise
from coopenv.observers.robust.memory import vec6d


@wp.func
def store_belief(memory: Any, world: int, i: int):
    """Store poses and covariance as they are before a correction."""
    for k in range(memory.belief[world, i].members):
        memory.scratch[world, k].last_correction = vec6d()
        memory.scratch[world, k].pose = memory.member[world, i, k].pose
        for j in range(k + 1):
            memory.scratch_blocks[world, k, j] = memory.P[world, i, k, j]


@wp.func
def restore_covariance(memory: Any, world: int, i: int):
    """Restore the covariance before a correction."""
    for k in range(memory.belief[world, i].members):
        for j in range(k + 1):
            P = memory.scratch_blocks[world, k, j]
            memory.P[world, i, k, j] = P
            memory.P[world, i, j, k] = wp.transpose(P)


@wp.func
def linearise_again(model: Any, memory: Any, world: int, i: int, share: Any):
    """Linearise the lines at where a share of the correction puts the poses, in the errors about those before."""
    for k in range(memory.belief[world, i].members):
        correction = share * memory.scratch[world, k].correction
        memory.scratch[world, k].last_correction = correction
        memory.scratch[world, k].recentring = recentring(correction)
        memory.member[world, i, k].pose = displaced(memory.scratch[world, k].pose, correction)
    for n in range(model.target_count[i]):
        if memory.line[world, n].fits == 1:
            linearise(model, memory, world, i, n)
            member = memory.line[world, n].member
            memory.line[world, n].jacobian = memory.line[world, n].jacobian * memory.scratch[world, 0].recentring
            if member > 0:
                G = memory.scratch[world, member].recentring
                memory.line[world, n].member_jacobian = memory.line[world, n].member_jacobian * G


@wp.func
def update_by_line(memory: Any, world: int, i: int, n: int):
    """Update the covariance by a line, and the correction by what the line says beyond those before."""
    members = memory.belief[world, i].members
    line = memory.line[world, n]
    for k in range(members):
        C = memory.P[world, i, k, 0] * wp.transpose(line.jacobian)
        if line.member > 0:
            C = C + memory.P[world, i, k, line.member] * wp.transpose(line.member_jacobian)
        memory.scratch[world, k].PHt = C
    S = line.noise * wp.identity(2, wp.float64) + line.jacobian * memory.scratch[world, 0].PHt
    own = memory.scratch[world, 0]  # where the lines were linearised, less the correction so far
    residual = line.residual + line.jacobian * (own.last_correction - own.correction)
    if line.member > 0:
        theirs = memory.scratch[world, line.member]
        S = S + line.member_jacobian * theirs.PHt
        residual = residual + line.member_jacobian * (theirs.last_correction - theirs.correction)
    weight = wp.inverse(S)
    for k in range(members):
        K = memory.scratch[world, k].PHt * weight
        memory.scratch[world, k].correction += K * residual
        for j in range(k + 1):
            subtract_block(memory, world, i, k, j, K * wp.transpose(memory.scratch[world, j].PHt))


@wp.func
def update_by_lines(memory: Any, world: int, i: int, lines: int):
    """Update the covariance by all lines that fit, and find the correction of the poses before.

    One line after the other, with the residual that those before have left, is the batch update.
    """
    for k in range(memory.belief[world, i].members):
        memory.scratch[world, k].correction = vec6d()
    for n in range(lines):
        if memory.line[world, n].fits == 1:
            update_by_line(memory, world, i, n)


@wp.func
def nearest(memory: Any, world: int, lines: int):
    """Return the distance of the nearest target whose line fits, m."""
    distance = wp.float64(wp.inf)
    for n in range(lines):
        if memory.line[world, n].fits == 1:
            distance = wp.min(distance, memory.line[world, n].distance)
    return distance


@wp.func
def turn_of_sight(error: Any, distance: Any):
    """Return by how much an error turns a line of sight of a length, rad."""
    size = wp.abs(error)
    return wp.max(wp.max(size[:3]), wp.max(size[3:]) / distance)


@wp.func
def next_share(memory: Any, world: int, i: int, lines: int, first: bool):
    """Return at which share of the correction to linearise next, 0 if that would be where it was done last.

    All of it where it turns a line of sight far, else half.
    """
    distance = nearest(memory, world, lines)
    turn = wp.float64(0.0)
    for k in range(memory.belief[world, i].members):
        turn = wp.max(turn, turn_of_sight(memory.scratch[world, k].correction, distance))
    share = wp.float64(1.0)
    if turn < wp.float64(RELINEARISATION_ANGLE):
        share = wp.float64(0.5)
    turn = wp.float64(0.0)
    for k in range(memory.belief[world, i].members):
        further = share * memory.scratch[world, k].correction - memory.scratch[world, k].last_correction
        turn = wp.max(turn, turn_of_sight(further, distance))
    if turn < wp.float64(RELINEARISATION_ANGLE) and not first:
        share = wp.float64(0.0)
    return share


@wp.func
def iterated_update(model: Any, memory: Any, world: int, i: int):
    """Correct by the lines that fit, linearised anew half way, or where they put the poses if that is far.

    Far, these are Gauss-Newton steps. Near, gain and innovation depend on the same noise: linearised where the poses
    were, ranges between vehicles that hardly move against each other drift outwards, where they get, inwards; half way
    the drift vanishes, as a Stratonovich integral has none.
    Source: Bell and Cathey, The iterated Kalman filter update as a Gauss-Newton method, IEEE Transactions on Automatic
    Control 38(2), 1993.
    """
    lines = model.target_count[i]
    store_belief(memory, world, i)
    update_by_lines(memory, world, i, lines)
    share = next_share(memory, world, i, lines, True)
    step = int(1)
    while share > wp.float64(0.0) and step < MAX_LINEARISATIONS:
        restore_covariance(memory, world, i)
        linearise_again(model, memory, world, i, share)
        update_by_lines(memory, world, i, lines)
        share = next_share(memory, world, i, lines, False)
        step += 1
    for k in range(memory.belief[world, i].members):
        memory.member[world, i, k].pose = memory.scratch[world, k].pose
    apply_corrections(memory, world, i)
