"""The vehicle's pose from one frame alone, whatever was believed of it before.

The other members stay. The vehicle's covariance becomes that of the solution, which inherits the members' errors,
G (N + H_o P_o H_o^T) G^T with G = (H^T W H)^-1 H^T W, and so do its covariances with them, -G H_o P_o.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from coopenv.observers.robust.algebra import inverse6, is_regular, with_noise
from coopenv.observers.robust.belief import apply_error
from coopenv.observers.robust.constants import GAUSS_NEWTON_STEPS, MIN_INFORMATION_RATIO
from coopenv.observers.robust.measurements import isotropic
from coopenv.observers.robust.types import mat66d, vec6d
from coopenv.observers.robust.update import gate, set_lines_to_belief


@wp.func
def weight_of(memory: Any, world: int, i: int, n: int):
    """Return the weight of a bearing, to whose variance the error of the member that it is to adds."""
    N = isotropic(memory.line[world, n].noise)
    member = memory.line[world, n].member
    if member > 0:
        G = memory.line[world, n].member_jacobian
        N = N + (G * memory.P[world, i, member, member]) * wp.transpose(G)
    return wp.inverse(N)


@wp.func
def normal_equations(memory: Any, world: int, i: int, lines: int):
    """Return (count, M, b) of the bearings that fit: M = H^T W H, b = H^T W residual."""
    M = mat66d()
    b = vec6d()
    count = int(0)
    for n in range(lines):
        if memory.line[world, n].fits == 1:
            H = memory.line[world, n].jacobian
            HtW = wp.transpose(H) * weight_of(memory, world, i, n)
            M += HtW * H
            b += HtW * memory.line[world, n].residual
            count += 1
    return count, M, b


@wp.func
def write_resected_covariance(memory: Any, world: int, i: int, lines: int, inverse: Any):
    """Set the vehicle's covariance to that of the solution, the members' errors included."""
    members = memory.belief[world, i].members
    own = mat66d()
    for k in range(members):
        memory.scratch[world, k].column = mat66d()
    for n in range(lines):
        if memory.line[world, n].fits == 1:
            Ht = wp.transpose(memory.line[world, n].jacobian)
            HtW = Ht * weight_of(memory, world, i, n)
            own += (HtW * wp.transpose(HtW)) * memory.line[world, n].noise
            member = memory.line[world, n].member
            if member > 0:
                HtWG = HtW * memory.line[world, n].member_jacobian
                memory.scratch[world, member].column = memory.scratch[world, member].column + HtWG
    for k in range(1, members):
        cross = mat66d()
        for j in range(1, members):
            cross += memory.scratch[world, j].column * memory.P[world, i, j, k]
        own += cross * wp.transpose(memory.scratch[world, k].column)
        block = -(inverse * cross)
        memory.P[world, i, 0, k] = block
        memory.P[world, i, k, 0] = wp.transpose(block)
    own = inverse * own * wp.transpose(inverse)
    memory.P[world, i, 0, 0] = with_noise(own, wp.float64(0.0), wp.float64(0.0))


@wp.func
def resect(model: Any, state: Any, memory: Any, world: int, i: int, tick: int) -> bool:
    """Put the vehicle where a frame's bearings see it, by least squares from where it is; return whether that works."""
    lines = model.target_count[i]
    set_lines_to_belief(model, state, memory, world, i, tick)
    inverse = mat66d()
    for step in range(GAUSS_NEWTON_STEPS):
        gate(model, memory, world, i)
        count, M, b = normal_equations(memory, world, i, lines)
        if count < 3:
            return False
        if not is_regular(M, wp.float64(MIN_INFORMATION_RATIO)):
            return False
        inverse = inverse6(M)
        if step < GAUSS_NEWTON_STEPS - 1:
            apply_error(memory, world, i, 0, inverse * b)
    write_resected_covariance(memory, world, i, lines, inverse)
    return True
