"""Matrices of up to 24x24 numbers in the memory's scratch: those of the vehicles that a joint message tells of."""

from __future__ import annotations

from typing import Any

import warp as wp

from coopenv.observers.robust.joint.memory import DIMENSION
from coopenv.observers.robust.memory import mat66d

BEFORE, AFTER, INVERSE, PRODUCT = 0, 1, 2, 3
"""The matrices."""


@wp.func
def block_of(memory: Any, world: int, x: int, a: int, b: int):
    """Return the 6x6 block (a, b) of the matrix x."""
    block = mat66d()
    for k in range(6):
        for j in range(6):
            block[k, j] = memory.matrix[world, x, (6 * a + k) * DIMENSION + 6 * b + j]
    return block


@wp.func
def set_block(memory: Any, world: int, x: int, a: int, b: int, block: Any):
    """Set the 6x6 block (a, b) of the matrix x."""
    for k in range(6):
        for j in range(6):
            memory.matrix[world, x, (6 * a + k) * DIMENSION + 6 * b + j] = block[k, j]


@wp.func
def multiply(memory: Any, world: int, x: int, y: int, z: int, count: int):
    """Write the product of the matrices x and y, of so many blocks, to z."""
    for a in range(count):
        for b in range(count):
            product = mat66d()
            for c in range(count):
                product += block_of(memory, world, x, a, c) * block_of(memory, world, y, c, b)
            set_block(memory, world, z, a, b, product)


@wp.func
def symmetrise(memory: Any, world: int, x: int, count: int):
    """Replace the matrix x, of so many blocks, by its symmetric part."""
    for a in range(count):
        for b in range(a + 1):
            block = block_of(memory, world, x, a, b)
            block = (block + wp.transpose(block_of(memory, world, x, b, a))) * wp.float64(0.5)
            set_block(memory, world, x, a, b, block)
            set_block(memory, world, x, b, a, wp.transpose(block))


@wp.func
def swap_rows(memory: Any, world: int, x: int, k: int, j: int, n: int):
    """Swap the first n numbers of two rows of the matrix x."""
    for c in range(n):
        kept = memory.matrix[world, x, k * DIMENSION + c]
        memory.matrix[world, x, k * DIMENSION + c] = memory.matrix[world, x, j * DIMENSION + c]
        memory.matrix[world, x, j * DIMENSION + c] = kept


@wp.func
def subtract_row(memory: Any, world: int, x: int, k: int, j: int, factor: Any, n: int):
    """Subtract a multiple of row k of the matrix x from its row j."""
    for c in range(n):
        left = memory.matrix[world, x, j * DIMENSION + c] - factor * memory.matrix[world, x, k * DIMENSION + c]
        memory.matrix[world, x, j * DIMENSION + c] = left


@wp.func
def invert(memory: Any, world: int, x: int, y: int, count: int):
    """Write the inverse of the matrix x, of so many blocks, to y, by Gauss-Jordan elimination; x is lost."""
    n = 6 * count
    for k in range(n):
        for c in range(n):
            memory.matrix[world, y, k * DIMENSION + c] = wp.where(k == c, wp.float64(1.0), wp.float64(0.0))
    for k in range(n):
        best = int(k)
        for j in range(k + 1, n):
            size = wp.abs(memory.matrix[world, x, j * DIMENSION + k])
            if size > wp.abs(memory.matrix[world, x, best * DIMENSION + k]):
                best = j
        if best != k:
            swap_rows(memory, world, x, k, best, n)
            swap_rows(memory, world, y, k, best, n)
        scale = wp.float64(1.0) / memory.matrix[world, x, k * DIMENSION + k]
        for c in range(n):
            memory.matrix[world, x, k * DIMENSION + c] = memory.matrix[world, x, k * DIMENSION + c] * scale
            memory.matrix[world, y, k * DIMENSION + c] = memory.matrix[world, y, k * DIMENSION + c] * scale
        for j in range(n):
            factor = memory.matrix[world, x, j * DIMENSION + k]
            if j != k and factor != wp.float64(0.0):
                subtract_row(memory, world, x, k, j, factor, n)
                subtract_row(memory, world, y, k, j, factor, n)


@wp.func
def factorise(memory: Any, world: int, x: int, n: int) -> bool:
    """Replace the lower triangle of the n x n matrix x by its Cholesky factor; return whether it has one."""
    for k in range(n):
        for j in range(k + 1):
            left = memory.matrix[world, x, k * DIMENSION + j]
            for c in range(j):
                left -= memory.matrix[world, x, k * DIMENSION + c] * memory.matrix[world, x, j * DIMENSION + c]
            if j < k:
                left = left / memory.matrix[world, x, j * DIMENSION + j]
            elif left > wp.float64(0.0):
                left = wp.sqrt(left)
            else:
                return False
            memory.matrix[world, x, k * DIMENSION + j] = left
    return True


@wp.func
def square_of_factor(memory: Any, world: int, i: int, sender: int, k: int, j: int):
    """Return the entry (k, j), j <= k, of the covariance whose factor has been received from a sender."""
    result = wp.float64(0.0)
    for c in range(j + 1):
        left = wp.float64(memory.inbox_factor[world, i, sender, (k * (k + 1)) // 2 + c])
        result += left * wp.float64(memory.inbox_factor[world, i, sender, (j * (j + 1)) // 2 + c])
    return result
