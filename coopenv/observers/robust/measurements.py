"""A frame's bearings as measurements of the belief, and the correction by them.

A line of sight is set once per frame, with the point that the bearing is to, and linearised at the poses believed now.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from coopenv.estimation.so3 import skew
from coopenv.observers.contract import MIN_BEARING_STD
from coopenv.observers.robust.belief import apply_error, subtract_block
from coopenv.observers.robust.constants import MAX_LINEARISATIONS, RELINEARISATION_ANGLE
from coopenv.observers.robust.types import (
    beside,
    first_half,
    mat22d,
    mat23d,
    second_half,
    vec6d,
    wide_vector,
)

PAPER_VARIANCE = 1.0 / 3.0
"""Variance of a uniform distribution over [-1, 1], which the paper's noise has on the image plane."""
NOTHING = -1
"""In place of a member: the bearing cannot be used now."""


@wp.func
def bearing_variance(model: Any):
    """Return the variance of a bearing per tangent axis."""
    std = wp.float64(model.noise.bearing)
    variance = std * std
    if model.noise.bearing_paper == 1:
        variance = variance * wp.float64(PAPER_VARIANCE)
    return wp.max(variance, wp.float64(MIN_BEARING_STD) * wp.float64(MIN_BEARING_STD))


@wp.func
def tangent_basis(b: Any):
    """Return two orthonormal rows across a unit vector (Duff et al., JCGT 6(1), 2017)."""
    one = wp.float64(1.0)
    sign = wp.where(b[2] < wp.float64(0.0), -one, one)
    a = -one / (sign + b[2])
    c = b[0] * b[1] * a
    return mat23d(one + sign * b[0] * b[0] * a, sign * c, -sign * b[0], c, sign + b[1] * b[1] * a, -b[1])


@wp.func
def isotropic(variance: Any):
    """Return variance I, 2x2."""
    o = wp.float64(0.0)
    return mat22d(variance, o, o, variance)


@wp.func
def set_line(memory: Any, world: int, n: int, member: int, b: Any, point: Any, variance: Any):
    """Let the n-th bearing b be to a point in the body of a member, or (member 0) in the map.

    `variance` is that of the point per axis, m^2, besides the member's own.
    """
    memory.line[world, n].member = member
    memory.line[world, n].bearing = b
    memory.line[world, n].point = point
    memory.line[world, n].variance = variance


@wp.func
def linearise(model: Any, memory: Any, world: int, i: int, n: int):
    """Linearise the n-th bearing, residual = H x + noise; return whether its target is ahead of the camera."""
    member = memory.line[world, n].member
    R = memory.member[world, i, 0].R
    point = memory.line[world, n].point
    z = point
    if member > 0:
        z = memory.member[world, i, member].p + memory.member[world, i, member].R * point
    a = wp.transpose(R) * (z - memory.member[world, i, 0].p)
    d = a - wide_vector(model.camera.position)
    distance = wp.max(wp.length(d), wp.float64(1.0e-9))
    u = d / distance
    T = tangent_basis(u)
    B = T / distance
    b = memory.line[world, n].bearing
    memory.line[world, n].jacobian = beside(B * skew(a), -B)
    if member > 0:
        G = B * (wp.transpose(R) * memory.member[world, i, member].R)
        memory.line[world, n].member_jacobian = beside(-(G * skew(point)), G)
    memory.line[world, n].residual = T * b
    memory.line[world, n].distance = distance
    memory.line[world, n].noise = bearing_variance(model) + memory.line[world, n].variance / (distance * distance)
    return wp.dot(u, b) > wp.float64(0.0)


@wp.func
def normalised_innovation(memory: Any, world: int, i: int, n: int):
    """Return a line's normalised innovation squared."""
    H = memory.line[world, n].jacobian
    Ht = wp.transpose(H)
    S = isotropic(memory.line[world, n].noise) + H * (memory.P[world, i, 0, 0] * Ht)
    member = memory.line[world, n].member
    if member > 0:
        G = memory.line[world, n].member_jacobian
        Gt = wp.transpose(G)
        cross = H * (memory.P[world, i, 0, member] * Gt)
        S = S + cross + wp.transpose(cross) + G * (memory.P[world, i, member, member] * Gt)
    residual = memory.line[world, n].residual
    return wp.dot(residual, wp.inverse(S) * residual)


@wp.func
def store_belief(memory: Any, world: int, i: int):
    """Store poses and covariance as they are before a correction."""
    for k in range(memory.belief[world, i].members):
        memory.scratch[world, k].last_correction = vec6d()
        memory.scratch[world, k].R = memory.member[world, i, k].R
        memory.scratch[world, k].p = memory.member[world, i, k].p
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
def remaining_correction(memory: Any, world: int, k: int):
    """Return the error of a member at which the lines were linearised, less the correction so far."""
    return memory.scratch[world, k].last_correction - memory.scratch[world, k].correction


@wp.func
def update_by_line(memory: Any, world: int, i: int, n: int):
    """Update the covariance by a line, and the correction by what the line says beyond those before."""
    members = memory.belief[world, i].members
    member = memory.line[world, n].member
    H = memory.line[world, n].jacobian
    G = memory.line[world, n].member_jacobian
    for k in range(members):
        C = memory.P[world, i, k, 0] * wp.transpose(H)
        if member > 0:
            C = C + memory.P[world, i, k, member] * wp.transpose(G)
        memory.scratch[world, k].PHt = C
    S = isotropic(memory.line[world, n].noise) + H * memory.scratch[world, 0].PHt
    residual = memory.line[world, n].residual + H * remaining_correction(memory, world, 0)
    if member > 0:
        S = S + G * memory.scratch[world, member].PHt
        residual = residual + G * remaining_correction(memory, world, member)
    weight = wp.inverse(S)
    for k in range(members):
        K = memory.scratch[world, k].PHt * weight
        memory.scratch[world, k].correction = memory.scratch[world, k].correction + K * residual
        for j in range(k + 1):
            subtract_block(memory, world, i, k, j, K * wp.transpose(memory.scratch[world, j].PHt))


@wp.func
def update_by_lines(memory: Any, world: int, i: int, lines: int):
    """Update the covariance by all lines that fit, and move the poses from where they were before.

    One line after the other, with the residual that those before have left, is the batch update.
    """
    for k in range(memory.belief[world, i].members):
        memory.scratch[world, k].correction = vec6d()
    for n in range(lines):
        if memory.line[world, n].fits == 1:
            update_by_line(memory, world, i, n)
    for k in range(memory.belief[world, i].members):
        memory.member[world, i, k].R = memory.scratch[world, k].R
        memory.member[world, i, k].p = memory.scratch[world, k].p
        apply_error(memory, world, i, k, memory.scratch[world, k].correction)


@wp.func
def largest(v: Any):
    """Return the largest absolute value of a 3-vector."""
    return wp.max(wp.max(wp.abs(v[0]), wp.abs(v[1])), wp.abs(v[2]))


@wp.func
def turn_of_sight(memory: Any, world: int, i: int, lines: int):
    """Return by how much the correction, beyond the last one, turns the lines of sight, rad."""
    distance = wp.float64(wp.inf)
    for n in range(lines):
        if memory.line[world, n].fits == 1:
            distance = wp.min(distance, memory.line[world, n].distance)
    turn = wp.float64(0.0)
    for k in range(memory.belief[world, i].members):
        step = memory.scratch[world, k].correction - memory.scratch[world, k].last_correction
        turn = wp.max(turn, wp.max(largest(first_half(step)), largest(second_half(step)) / distance))
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


@wp.func
def fitting_lines(memory: Any, world: int, lines: int) -> int:
    """Return how many lines fit."""
    count = int(0)
    for n in range(lines):
        count += memory.line[world, n].fits
    return count
