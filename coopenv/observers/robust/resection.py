"""The vehicle's pose from one frame alone. See observers/robust/resection.py."""

from __future__ import annotations

from typing import Any

import warp as wp

from coopenv.observers.robust.algebra import inverse6, is_regular, with_noise
from coopenv.observers.robust.belief import shift
from coopenv.observers.robust.measurements import isotropic
from coopenv.observers.robust.reference.resection import LEAST_INFORMATION, STEPS
from coopenv.observers.robust.types import mat66d, vec6d
from coopenv.observers.robust.update import aim_at_belief, examine

GAUSS_NEWTON_STEPS = wp.constant(STEPS)
LEAST_SHARE = wp.constant(LEAST_INFORMATION)


@wp.func
def weight_of(mind: Any, world: int, i: int, n: int):
    """Return the weight of a bearing, which counts the error of the member that it is about."""
    N = isotropic(mind.line_noise[world, n])
    place = mind.line_place[world, n]
    if place > 0:
        G = mind.line_other[world, n]
        N = N + (G * mind.P[world, i, place, place]) * wp.transpose(G)
    return wp.inverse(N)


@wp.func
def normal_equations(mind: Any, world: int, i: int, lines: int):
    """Return (count, M, b) of the bearings that fit: M = H^T W H, b = H^T W residual."""
    M = mat66d()
    b = vec6d()
    count = int(0)
    for n in range(lines):
        if mind.line_fits[world, n] == 1:
            H = mind.line_own[world, n]
            HtW = wp.transpose(H) * weight_of(mind, world, i, n)
            M += HtW * H
            b += HtW * mind.line_residual[world, n]
            count += 1
    return count, M, b


@wp.func
def inherit(mind: Any, world: int, i: int, lines: int, inverse: Any):
    """Set the vehicle's covariance to that of the solution, the members' errors included."""
    members = mind.members[world, i]
    own = mat66d()
    for k in range(members):
        mind.column[world, k] = mat66d()
    for n in range(lines):
        if mind.line_fits[world, n] == 1:
            Ht = wp.transpose(mind.line_own[world, n])
            HtW = Ht * weight_of(mind, world, i, n)
            own += (HtW * wp.transpose(HtW)) * mind.line_noise[world, n]
            place = mind.line_place[world, n]
            if place > 0:
                mind.column[world, place] = mind.column[world, place] + HtW * mind.line_other[world, n]
    for k in range(1, members):
        cross = mat66d()
        for j in range(1, members):
            cross += mind.column[world, j] * mind.P[world, i, j, k]
        own += cross * wp.transpose(mind.column[world, k])
        block = -(inverse * cross)
        mind.P[world, i, 0, k] = block
        mind.P[world, i, k, 0] = wp.transpose(block)
    own = inverse * own * wp.transpose(inverse)
    mind.P[world, i, 0, 0] = with_noise(own, wp.float64(0.0), wp.float64(0.0))


@wp.func
def resect(model: Any, state: Any, mind: Any, world: int, i: int, tick: int) -> bool:
    """Put the vehicle where a frame's bearings see it, by least squares from where it is; return whether that works."""
    lines = model.target_count[i]
    aim_at_belief(model, state, mind, world, i, tick)
    inverse = mat66d()
    for step in range(GAUSS_NEWTON_STEPS):
        examine(model, mind, world, i)
        count, M, b = normal_equations(mind, world, i, lines)
        if count < 3:
            return False
        if not is_regular(M, wp.float64(LEAST_SHARE)):
            return False
        inverse = inverse6(M)
        if step < GAUSS_NEWTON_STEPS - 1:
            shift(mind, world, i, 0, inverse * b)
    inherit(mind, world, i, lines, inverse)
    return True
