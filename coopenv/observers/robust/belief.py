"""The joint belief of one vehicle: its own pose and those of vehicles that it hears, with one covariance.

Errors are left errors, R = Rhat Exp(theta), p = phat + Rhat rho, six per member, the vehicle itself first; the
covariance is kept in blocks of 6x6. A member stands where its last message put it.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from coopenv.estimation.so3 import exp_so3, orthonormalise
from coopenv.observers.robust.algebra import inverse6, transition, with_noise
from coopenv.observers.robust.memory import Member
from coopenv.observers.robust.types import first_half, mat66d, second_half


@wp.func
def index_of(memory: Any, world: int, i: int, vehicle: int) -> int:
    """Return the index of a vehicle among the members of i's belief, 0 if it is not one of the others."""
    for n in range(1, memory.belief[world, i].members):
        if memory.member[world, i, n].vehicle == vehicle:
            return n
    return 0


@wp.func
def propagate(memory: Any, world: int, i: int, n: int, dR: Any, dp: Any, rotation: Any, translation: Any):
    """Carry a member through an odometry increment with noise variances per axis."""
    R = memory.member[world, i, n].R
    memory.member[world, i, n].p = memory.member[world, i, n].p + R * dp
    memory.member[world, i, n].R = orthonormalise(R * dR)
    F = transition(dR, dp)
    for k in range(memory.belief[world, i].members):
        if k != n:
            block = F * memory.P[world, i, n, k]
            memory.P[world, i, n, k] = block
            memory.P[world, i, k, n] = wp.transpose(block)
    memory.P[world, i, n, n] = with_noise(F * memory.P[world, i, n, n] * wp.transpose(F), rotation, translation)


@wp.func
def apply_error(memory: Any, world: int, i: int, n: int, error: Any):
    """Move a member's pose by an error."""
    R = memory.member[world, i, n].R
    memory.member[world, i, n].p = memory.member[world, i, n].p + R * second_half(error)
    memory.member[world, i, n].R = R * exp_so3(first_half(error))


@wp.func
def subtract_block(memory: Any, world: int, i: int, k: int, j: int, block: Any):
    """Subtract a block from the covariance at (k, j), and its transpose at (j, k)."""
    left = memory.P[world, i, k, j] - block
    if k == j:
        left = (left + wp.transpose(left)) * wp.float64(0.5)
    memory.P[world, i, k, j] = left
    memory.P[world, i, j, k] = wp.transpose(left)


@wp.func
def fuse_information(memory: Any, world: int, i: int, n: int, information: Any, vector: Any):
    """Fuse information about a member's error x, whose likelihood has the exponent vector^T x - x^T information x / 2.

    P' = P - P_n M P_n^T with M = information (I + P_nn information)^-1, P_n being the member's columns.
    """
    members = memory.belief[world, i].members
    product = memory.P[world, i, n, n] * information
    for k in range(6):
        product[k, k] = product[k, k] + wp.float64(1.0)
    W = inverse6(product)
    M = information * W
    M = (M + wp.transpose(M)) * wp.float64(0.5)
    along = wp.transpose(W) * vector
    for k in range(members):
        memory.scratch[world, k].column = memory.P[world, i, k, n]
    for k in range(members):
        gain = memory.scratch[world, k].column * M
        for j in range(k + 1):
            subtract_block(memory, world, i, k, j, gain * wp.transpose(memory.scratch[world, j].column))
        apply_error(memory, world, i, k, memory.scratch[world, k].column * along)


@wp.func
def append_member(memory: Any, world: int, i: int, vehicle: int, R: Any, p: Any, P: Any):
    """Add a member whose error is independent of those of the others; there must be room. Nothing else is set."""
    n = memory.belief[world, i].members
    for k in range(n):
        memory.P[world, i, n, k] = mat66d()
        memory.P[world, i, k, n] = mat66d()
    memory.P[world, i, n, n] = P
    member = Member()
    member.vehicle = vehicle
    member.R = R
    member.p = p
    memory.member[world, i, n] = member
    memory.belief[world, i].members = n + 1


@wp.func
def remove_member(memory: Any, world: int, i: int, n: int):
    """Remove a member; those behind it move up."""
    members = memory.belief[world, i].members
    for m in range(n + 1, members):
        memory.member[world, i, m - 1] = memory.member[world, i, m]
        for k in range(members):
            memory.P[world, i, m - 1, k] = memory.P[world, i, m, k]
    for m in range(n + 1, members):
        for k in range(members):
            memory.P[world, i, k, m - 1] = memory.P[world, i, k, m]
    memory.belief[world, i].members = members - 1


@wp.func
def begin_belief(memory: Any, world: int, i: int, R: Any, p: Any, P: Any):
    """Believe in the vehicle itself alone."""
    memory.belief[world, i].members = 1
    memory.member[world, i, 0].vehicle = i
    memory.member[world, i, 0].R = R
    memory.member[world, i, 0].p = p
    memory.P[world, i, 0, 0] = P
