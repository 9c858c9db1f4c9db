"""The joint belief of one vehicle: poses with one covariance in 6x6 blocks. See observers/robust/belief.py."""

from __future__ import annotations

from typing import Any

import warp as wp

from coopenv.estimation.so3 import exp_so3, orthonormalise
from coopenv.observers.robust.algebra import inverse6, transition, with_noise
from coopenv.observers.robust.types import (
    first_half,
    mat66d,
    second_half,
)


@wp.func
def place_of(mind: Any, world: int, i: int, vehicle: int) -> int:
    """Return a vehicle's number among the members of i's belief, 0 if it is not one."""
    for n in range(1, mind.members[world, i]):
        if mind.vehicle[world, i, n] == vehicle:
            return n
    return 0


@wp.func
def move(mind: Any, world: int, i: int, n: int, dR: Any, dp: Any, rotation: Any, translation: Any):
    """Carry a member through an odometry increment with noise variances per axis."""
    R = mind.R[world, i, n]
    mind.p[world, i, n] = mind.p[world, i, n] + R * dp
    mind.R[world, i, n] = orthonormalise(R * dR)
    F = transition(dR, dp)
    for k in range(mind.members[world, i]):
        if k != n:
            block = F * mind.P[world, i, n, k]
            mind.P[world, i, n, k] = block
            mind.P[world, i, k, n] = wp.transpose(block)
    mind.P[world, i, n, n] = with_noise(F * mind.P[world, i, n, n] * wp.transpose(F), rotation, translation)


@wp.func
def shift(mind: Any, world: int, i: int, n: int, dx: Any):
    """Move a member's pose by an error."""
    R = mind.R[world, i, n]
    mind.p[world, i, n] = mind.p[world, i, n] + R * second_half(dx)
    mind.R[world, i, n] = R * exp_so3(first_half(dx))


@wp.func
def lower(mind: Any, world: int, i: int, k: int, j: int, block: Any):
    """Take a block off the covariance, at (k, j) and transposed at (j, k)."""
    left = mind.P[world, i, k, j] - block
    if k == j:
        left = (left + wp.transpose(left)) * wp.float64(0.5)
    mind.P[world, i, k, j] = left
    mind.P[world, i, j, k] = wp.transpose(left)


@wp.func
def inform(mind: Any, world: int, i: int, n: int, information: Any, vector: Any):
    """Take information about a member's error x: its likelihood has the exponent vector^T x - x^T information x / 2."""
    members = mind.members[world, i]
    product = mind.P[world, i, n, n] * information
    for k in range(6):
        product[k, k] = product[k, k] + wp.float64(1.0)
    W = inverse6(product)
    M = information * W
    M = (M + wp.transpose(M)) * wp.float64(0.5)
    along = wp.transpose(W) * vector
    for k in range(members):
        mind.column[world, k] = mind.P[world, i, k, n]
    for k in range(members):
        gain = mind.column[world, k] * M
        for j in range(k + 1):
            lower(mind, world, i, k, j, gain * wp.transpose(mind.column[world, j]))
        shift(mind, world, i, k, mind.column[world, k] * along)


@wp.func
def add(mind: Any, world: int, i: int, vehicle: int, R: Any, p: Any, P: Any):
    """Take in a member whose error is independent of those of the others; there must be room."""
    n = mind.members[world, i]
    for k in range(n):
        mind.P[world, i, n, k] = mat66d()
        mind.P[world, i, k, n] = mat66d()
    mind.P[world, i, n, n] = P
    mind.vehicle[world, i, n] = vehicle
    mind.R[world, i, n] = R
    mind.p[world, i, n] = p
    mind.twists[world, i, n] = 0
    mind.members[world, i] = n + 1


@wp.func
def begin(mind: Any, world: int, i: int, R: Any, p: Any, P: Any):
    """Believe in the vehicle itself alone."""
    mind.members[world, i] = 1
    mind.vehicle[world, i, 0] = i
    mind.R[world, i, 0] = R
    mind.p[world, i, 0] = p
    mind.P[world, i, 0, 0] = P
