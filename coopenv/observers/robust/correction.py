"""The correction of the belief by a frame's bearings."""

from typing import Any

import warp as wp

from coopenv.observers.robust.belief import apply_error, subtract_block
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
    """Restore the covariance before a correction; the correction so far becomes the last one."""
    for k in range(memory.belief[world, i].members):
        memory.scratch[world, k].last_correction = memory.scratch[world, k].correction
        for j in range(k + 1):
            P = memory.scratch_blocks[world, k, j]
            memory.P[world, i, k, j] = P
            memory.P[world, i, j, k] = wp.transpose(P)


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
    """Update the covariance by all lines that fit, and move the poses from where they were before.

    One line after the other, with the residual that those before have left, is the batch update.
    """
    members = memory.belief[world, i].members
    for k in range(members):
        memory.scratch[world, k].correction = vec6d()
    for n in range(lines):
        if memory.line[world, n].fits == 1:
            update_by_line(memory, world, i, n)
    for k in range(members):
        memory.member[world, i, k].pose = memory.scratch[world, k].pose
        apply_error(memory, world, i, k, memory.scratch[world, k].correction)


@wp.func
def turn_of_sight(memory: Any, world: int, i: int, lines: int):
    """Return by how much the correction, beyond the last one, turns the lines of sight, rad."""
    distance = wp.float64(wp.inf)
    for n in range(lines):
        if memory.line[world, n].fits == 1:
            distance = wp.min(distance, memory.line[world, n].distance)
    turn = wp.float64(0.0)
    for k in range(memory.belief[world, i].members):
        step = wp.abs(memory.scratch[world, k].correction - memory.scratch[world, k].last_correction)
        turn = wp.max(turn, wp.max(wp.max(step[:3]), wp.max(step[3:]) / distance))
    return turn


@wp.func
def iterated_update(model: Any, memory: Any, world: int, i: int):
    """Correct by the lines that fit, linearised anew at where they put the poses while that is far from before.

    Source: the iterated extended Kalman filter as Gauss-Newton steps, Bell and Cathey, The iterated Kalman filter
    update as a Gauss-Newton method, IEEE Transactions on Automatic Control 38(2), 1993.
    """
    lines = model.target_count[i]
    store_belief(memory, world, i)
    step = int(0)
    while step < MAX_LINEARISATIONS:
        if step > 0:
            restore_covariance(memory, world, i)
            for n in range(lines):
                if memory.line[world, n].fits == 1:
                    linearise(model, memory, world, i, n)
        update_by_lines(memory, world, i, lines)
        step += 1
        if turn_of_sight(memory, world, i, lines) < wp.float64(RELINEARISATION_ANGLE):
            step = MAX_LINEARISATIONS
