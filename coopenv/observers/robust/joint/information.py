"""The new information between two messages of a sender about the same vehicles, as in `tracklets`, but joint."""

from typing import Any

import warp as wp

from coopenv.observers.robust.algebra import between, left_error, moved, recentring, transition
from coopenv.observers.robust.belief import apply_corrections, index_of, subtract_block
from coopenv.observers.robust.constants import MAX_TOLD, MAX_VARIANCE_GROWTH
from coopenv.observers.robust.joint.matrices import (
    AFTER,
    BEFORE,
    INVERSE,
    entry,
    invert,
    multiply,
    recentre,
    symmetrise,
)
from coopenv.observers.robust.memory import mat66d, vec6d
from coopenv.observers.robust.odometry import increment_noise
from coopenv.observers.robust.tracklets import propagate_member
from coopenv.world.device_function import device_function


@device_function
def predict_told(model: Any, memory: Any, world: int, i: int, c: int, count: int):
    """Carry the contact's last message on to the new one by odometry: poses to `step`, covariance to BEFORE."""
    for a in range(count):
        last = memory.contact_told[world, i, c, a]
        step = between(last.odometry, memory.told[world, a].odometry)
        memory.step[world, a] = moved(last.pose, step)
        F = transition(step)
        for b in range(count):
            memory.matrix[world, BEFORE, a, b] = F * memory.contact_P[world, i, c, MAX_TOLD * a + b]
        memory.scratch[world, a].column = F
    for a in range(count):
        for b in range(count):
            Ft = wp.transpose(memory.scratch[world, b].column)
            memory.matrix[world, BEFORE, a, b] = memory.matrix[world, BEFORE, a, b] * Ft
        ticks = wp.max(memory.told[world, a].tick - memory.contact_told[world, i, c, a].tick, 0)
        dt = wp.float64(ticks) * model.camera_period
        step = between(memory.contact_told[world, i, c, a].odometry, memory.told[world, a].odometry)
        noise = increment_noise(model, memory, world, i, step, dt)
        block = memory.matrix[world, BEFORE, a, a]
        for k in range(6):
            block[k, k] += noise[k // 3]
        memory.matrix[world, BEFORE, a, a] = block


@device_function
def propagate_told(model: Any, memory: Any, world: int, i: int, count: int):
    """Carry the members that a message tells of on to where it says that they were, unless they stand there already."""
    for a in range(count):
        told = memory.told[world, a]
        n = index_of(memory, world, i, told.vehicle)
        if n > 0:
            last = memory.member[world, i, n].report
            if told.tick > last.tick:
                dt = wp.float64(told.tick - last.tick) * model.camera_period
                step = between(last.odometry, told.odometry)
                noise = increment_noise(model, memory, world, i, step, dt)
                propagate_member(model, memory, world, i, n, step, dt, noise)
                memory.member[world, i, n].report.tick = told.tick
                memory.member[world, i, n].report.odometry = told.odometry


@device_function
def news_of(memory: Any, world: int, i: int, count: int, share: Any) -> bool:
    """Turn the covariances BEFORE and AFTER into new information, of which a share counts; return whether there is any.

    Its matrix takes the place of BEFORE, its vector that of the corrections in `scratch`.
    """
    for k in range(6 * count):
        if entry(memory, world, AFTER, k, k) > wp.float64(MAX_VARIANCE_GROWTH) * entry(memory, world, BEFORE, k, k):
            return False
    invert(memory, world, AFTER, INVERSE, count)
    for a in range(count):  # of the errors about `step`, as the rest
        memory.scratch[world, a].recentring = recentring(left_error(memory.step[world, a], memory.told[world, a].pose))
    recentre(memory, world, INVERSE, count)
    for a in range(count):
        vector = vec6d()
        for b in range(count):
            news = left_error(memory.step[world, b], memory.told[world, b].pose)
            vector += memory.matrix[world, INVERSE, a, b] * news
        memory.scratch[world, a].correction = vector
    invert(memory, world, BEFORE, AFTER, count)
    for a in range(count):
        for b in range(count):
            new = memory.matrix[world, INVERSE, a, b] - memory.matrix[world, AFTER, a, b]
            memory.matrix[world, BEFORE, a, b] = share * new
    symmetrise(memory, world, BEFORE, count)
    size = wp.float64(0.0)
    for a in range(count):
        vector = share * memory.scratch[world, a].correction
        for b in range(count):
            n = index_of(memory, world, i, memory.told[world, b].vehicle)
            offset = left_error(memory.step[world, b], memory.member[world, i, n].pose)
            vector = vector - memory.matrix[world, BEFORE, a, b] * offset
        memory.scratch[world, a].correction = vector
        size += wp.dot(vector, vector)
    for a in range(count):  # of the errors about the members, backwards, to second order
        n = index_of(memory, world, i, memory.told[world, a].vehicle)
        G = recentring(-left_error(memory.step[world, a], memory.member[world, i, n].pose))
        memory.scratch[world, a].recentring = G
        memory.scratch[world, a].correction = wp.transpose(G) * memory.scratch[world, a].correction
    recentre(memory, world, BEFORE, count)
    return wp.isfinite(size)


@device_function
def fuse_joint_information(memory: Any, world: int, i: int, count: int):
    """Fuse information about the errors of all that a message tells of, see `fuse_information`.

    The matrix BEFORE and the corrections in `scratch` hold it.
    """
    members = memory.belief[world, i].members
    for a in range(count):
        m = index_of(memory, world, i, memory.told[world, a].vehicle)
        for k in range(members):
            memory.blocks[world, k, a] = memory.P[world, i, k, m]
    for a in range(count):
        n = index_of(memory, world, i, memory.told[world, a].vehicle)
        for b in range(count):
            block = mat66d()
            for c in range(count):
                block += memory.blocks[world, n, c] * memory.matrix[world, BEFORE, c, b]
            if a == b:
                block += wp.identity(6, wp.float64)
            memory.matrix[world, AFTER, a, b] = block
    invert(memory, world, AFTER, INVERSE, count)
    for a in range(count):
        along = vec6d()
        for b in range(count):
            along += wp.transpose(memory.matrix[world, INVERSE, b, a]) * memory.scratch[world, b].correction
        memory.scratch[world, a].last_correction = along
    multiply(memory, world, BEFORE, INVERSE, AFTER, count)
    symmetrise(memory, world, AFTER, count)
    for k in range(members):
        error = vec6d()
        for b in range(count):
            error += memory.blocks[world, k, b] * memory.scratch[world, b].last_correction
            gain = mat66d()
            for a in range(count):
                gain += memory.blocks[world, k, a] * memory.matrix[world, AFTER, a, b]
            for j in range(k + 1):
                subtract_block(memory, world, i, k, j, gain * wp.transpose(memory.blocks[world, j, b]))
        memory.scratch[world, k].correction = error
    apply_corrections(memory, world, i)
