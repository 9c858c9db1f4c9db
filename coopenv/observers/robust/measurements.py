"""A frame's bearings as measurements of the belief, and the correction by them. See observers/robust/belief.py.

`aim` says what each bearing is about, once per frame; `draw` linearises it at the poses believed now.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from coopenv.estimation.so3 import skew
from coopenv.observers.contract import MIN_BEARING_STD
from coopenv.observers.robust.belief import lower, shift
from coopenv.observers.robust.reference.belief import MOST_STEPS, STRAIGHT
from coopenv.observers.robust.types import (
    beside,
    first_half,
    mat22d,
    mat23d,
    second_half,
    vec6d,
    wide_vector,
)

LEAST_BEARING = wp.constant(MIN_BEARING_STD)
PAPER_VARIANCE = wp.constant(1.0 / 3.0)
"""Variance of a uniform distribution over [-1, 1], which the paper's noise has on the image plane."""
LINEARISATIONS, LEAST_BEND = wp.constant(MOST_STEPS), wp.constant(STRAIGHT)
NOTHING = wp.constant(-1)
"""In place of a member: the bearing is of no use now."""


@wp.func
def bearing_variance(model: Any):
    """Return the variance of a bearing per tangent axis."""
    std = wp.float64(model.noise.bearing)
    variance = std * std
    if model.noise.bearing_paper == 1:
        variance = variance * wp.float64(PAPER_VARIANCE)
    return wp.max(variance, wp.float64(LEAST_BEARING) * wp.float64(LEAST_BEARING))


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
def aim(mind: Any, world: int, n: int, place: int, b: Any, point: Any, variance: Any):
    """Say what the n-th bearing b is about: a point in the body of the member `place`, or (0) one in the map.

    `variance` is that of the point per axis, m^2, besides the member's own.
    """
    mind.line_place[world, n] = place
    mind.line_bearing[world, n] = b
    mind.line_point[world, n] = point
    mind.line_spread[world, n] = variance


@wp.func
def draw(model: Any, mind: Any, world: int, i: int, n: int):
    """Write the n-th bearing as a measurement, residual = H x + noise; return whether its target is ahead."""
    place = mind.line_place[world, n]
    R = mind.R[world, i, 0]
    point = mind.line_point[world, n]
    z = point
    if place > 0:
        z = mind.p[world, i, place] + mind.R[world, i, place] * point
    a = wp.transpose(R) * (z - mind.p[world, i, 0])
    d = a - wide_vector(model.camera.position)
    distance = wp.max(wp.length(d), wp.float64(1.0e-9))
    u = d / distance
    T = tangent_basis(u)
    B = T / distance
    b = mind.line_bearing[world, n]
    mind.line_own[world, n] = beside(B * skew(a), -B)
    if place > 0:
        G = B * (wp.transpose(R) * mind.R[world, i, place])
        mind.line_other[world, n] = beside(-(G * skew(point)), G)
    mind.line_residual[world, n] = T * b
    mind.line_distance[world, n] = distance
    mind.line_noise[world, n] = bearing_variance(model) + mind.line_spread[world, n] / (distance * distance)
    return wp.dot(u, b) > wp.float64(0.0)


@wp.func
def normalised(mind: Any, world: int, i: int, n: int):
    """Return a line's normalised innovation squared."""
    H = mind.line_own[world, n]
    Ht = wp.transpose(H)
    S = isotropic(mind.line_noise[world, n]) + H * (mind.P[world, i, 0, 0] * Ht)
    place = mind.line_place[world, n]
    if place > 0:
        G = mind.line_other[world, n]
        Gt = wp.transpose(G)
        cross = H * (mind.P[world, i, 0, place] * Gt)
        S = S + cross + wp.transpose(cross) + G * (mind.P[world, i, place, place] * Gt)
    residual = mind.line_residual[world, n]
    return wp.dot(residual, wp.inverse(S) * residual)


@wp.func
def keep_belief(mind: Any, world: int, i: int):
    """Keep poses and covariance as they are before a correction."""
    for k in range(mind.members[world, i]):
        mind.last[world, k] = vec6d()
        mind.before_rotation[world, k] = mind.R[world, i, k]
        mind.before_position[world, k] = mind.p[world, i, k]
        for j in range(k + 1):
            mind.before_covariance[world, k, j] = mind.P[world, i, k, j]


@wp.func
def restore_covariance(mind: Any, world: int, i: int):
    """Take the covariance before a correction; the correction so far becomes the last one."""
    for k in range(mind.members[world, i]):
        mind.last[world, k] = mind.dx[world, k]
        for j in range(k + 1):
            P = mind.before_covariance[world, k, j]
            mind.P[world, i, k, j] = P
            mind.P[world, i, j, k] = wp.transpose(P)


@wp.func
def condense_line(mind: Any, world: int, i: int, n: int):
    """Take a line into the covariance, and add to the correction what it says beyond those before."""
    members = mind.members[world, i]
    place = mind.line_place[world, n]
    H = mind.line_own[world, n]
    G = mind.line_other[world, n]
    for k in range(members):
        C = mind.P[world, i, k, 0] * wp.transpose(H)
        if place > 0:
            C = C + mind.P[world, i, k, place] * wp.transpose(G)
        mind.narrow[world, k] = C
    S = isotropic(mind.line_noise[world, n]) + H * mind.narrow[world, 0]
    residual = mind.line_residual[world, n] + H * (mind.last[world, 0] - mind.dx[world, 0])
    if place > 0:
        S = S + G * mind.narrow[world, place]
        residual = residual + G * (mind.last[world, place] - mind.dx[world, place])
    weight = wp.inverse(S)
    for k in range(members):
        K = mind.narrow[world, k] * weight
        mind.dx[world, k] = mind.dx[world, k] + K * residual
        for j in range(k + 1):
            lower(mind, world, i, k, j, K * wp.transpose(mind.narrow[world, j]))


@wp.func
def condense(mind: Any, world: int, i: int, lines: int):
    """Take all lines that fit into the covariance, and put the poses where they say, from where they were before.

    One line after the other, with the residual that those before have left, is the batch update.
    """
    for k in range(mind.members[world, i]):
        mind.dx[world, k] = vec6d()
    for n in range(lines):
        if mind.line_fits[world, n] == 1:
            condense_line(mind, world, i, n)
    for k in range(mind.members[world, i]):
        mind.R[world, i, k] = mind.before_rotation[world, k]
        mind.p[world, i, k] = mind.before_position[world, k]
        shift(mind, world, i, k, mind.dx[world, k])


@wp.func
def largest(v: Any):
    """Return the largest absolute value of a 3-vector."""
    return wp.max(wp.max(wp.abs(v[0]), wp.abs(v[1])), wp.abs(v[2]))


@wp.func
def bend(mind: Any, world: int, i: int, lines: int):
    """Return by how much the correction, beyond the last one, turns the lines of sight, rad."""
    distance = wp.float64(wp.inf)
    for n in range(lines):
        if mind.line_fits[world, n] == 1:
            distance = wp.min(distance, mind.line_distance[world, n])
    turn = wp.float64(0.0)
    for k in range(mind.members[world, i]):
        step = mind.dx[world, k] - mind.last[world, k]
        turn = wp.max(turn, wp.max(largest(first_half(step)), largest(second_half(step)) / distance))
    return turn


@wp.func
def settle(model: Any, mind: Any, world: int, i: int):
    """Correct by the lines that fit, linearised anew at where they put the poses while that is far from before."""
    lines = model.target_count[i]
    keep_belief(mind, world, i)
    step = int(0)
    while step < LINEARISATIONS:
        if step > 0:
            restore_covariance(mind, world, i)
            for n in range(lines):
                if mind.line_fits[world, n] == 1:
                    draw(model, mind, world, i, n)
        condense(mind, world, i, lines)
        step += 1
        if bend(mind, world, i, lines) < wp.float64(LEAST_BEND):
            step = LINEARISATIONS


@wp.func
def fitting_lines(mind: Any, world: int, lines: int) -> int:
    """Return how many lines fit."""
    count = int(0)
    for n in range(lines):
        count += mind.line_fits[world, n]
    return count
