"""Matrices of up to 4x4 blocks of 6x6 in the memory's scratch: those of the vehicles that a joint message tells of."""

from typing import Any

import warp as wp

from coopenv.observers.robust.memory import mat66d
from coopenv.world.device_function import device_function

BEFORE, AFTER, INVERSE = 0, 1, 2  # the matrices


@device_function
def multiply(memory: Any, world: int, x: int, y: int, z: int, count: int):
    """Write the product of the matrices x and y, of so many blocks, to z."""
    for a in range(count):
        for b in range(count):
            product = mat66d()
            for c in range(count):
                product += memory.matrix[world, x, a, c] * memory.matrix[world, y, c, b]
            memory.matrix[world, z, a, b] = product


@device_function
def recentre(memory: Any, world: int, x: int, count: int):
    """Turn the information x about some errors into that about others, of which `scratch` holds the derivatives."""
    for a in range(count):
        Gt = wp.transpose(memory.scratch[world, a].recentring)
        for b in range(count):
            block = Gt * memory.matrix[world, x, a, b] * memory.scratch[world, b].recentring
            memory.matrix[world, x, a, b] = block


@device_function
def symmetrise(memory: Any, world: int, x: int, count: int):
    """Replace the matrix x, of so many blocks, by its symmetric part."""
    for a in range(count):
        for b in range(a + 1):
            block = memory.matrix[world, x, a, b]
            block = (block + wp.transpose(memory.matrix[world, x, b, a])) * wp.float64(0.5)
            memory.matrix[world, x, a, b] = block
            memory.matrix[world, x, b, a] = wp.transpose(block)


@device_function
def entry(memory: Any, world: int, x: int, k: int, j: int):
    """Return the number (k, j) of the matrix x."""
    return memory.matrix[world, x, k // 6, j // 6][k % 6, j % 6]


@device_function
def swap_rows(memory: Any, world: int, x: int, k: int, j: int, count: int):
    """Swap two rows of the matrix x."""
    for b in range(count):
        row = memory.matrix[world, x, k // 6, b][k % 6]
        memory.matrix[world, x, k // 6, b][k % 6] = memory.matrix[world, x, j // 6, b][j % 6]
        memory.matrix[world, x, j // 6, b][j % 6] = row


@device_function
def subtract_row(memory: Any, world: int, x: int, k: int, j: int, factor: Any, count: int):
    """Subtract a multiple of row k of the matrix x from its row j."""
    for b in range(count):
        row = memory.matrix[world, x, j // 6, b][j % 6] - factor * memory.matrix[world, x, k // 6, b][k % 6]
        memory.matrix[world, x, j // 6, b][j % 6] = row


@device_function
def invert(memory: Any, world: int, x: int, y: int, count: int):
    """Write the inverse of the matrix x, of so many blocks, to y, by Gauss-Jordan elimination; x is lost."""
    n = 6 * count
    for a in range(count):
        for b in range(count):
            memory.matrix[world, y, a, b] = mat66d()
        memory.matrix[world, y, a, a] = wp.identity(6, wp.float64)
    for k in range(n):
        best = int(k)
        for j in range(k + 1, n):
            if wp.abs(entry(memory, world, x, j, k)) > wp.abs(entry(memory, world, x, best, k)):
                best = j
        if best != k:
            swap_rows(memory, world, x, k, best, count)
            swap_rows(memory, world, y, k, best, count)
        scale = wp.float64(1.0) / entry(memory, world, x, k, k)
        for b in range(count):
            memory.matrix[world, x, k // 6, b][k % 6] = memory.matrix[world, x, k // 6, b][k % 6] * scale
            memory.matrix[world, y, k // 6, b][k % 6] = memory.matrix[world, y, k // 6, b][k % 6] * scale
        for j in range(n):
            factor = entry(memory, world, x, j, k)
            if j != k and factor != wp.float64(0.0):
                subtract_row(memory, world, x, k, j, factor, count)
                subtract_row(memory, world, y, k, j, factor, count)


@device_function
def factorise(memory: Any, world: int, x: int, n: int) -> bool:
    """Replace the lower triangle of the n x n matrix x by its Cholesky factor; return whether it has one."""
    for k in range(n):
        for j in range(k + 1):
            left = entry(memory, world, x, k, j)
            for c in range(j):
                left -= entry(memory, world, x, k, c) * entry(memory, world, x, j, c)
            if j < k:
                left = left / entry(memory, world, x, j, j)
            elif left > wp.float64(0.0):
                left = wp.sqrt(left)
            else:
                return False
            memory.matrix[world, x, k // 6, j // 6][k % 6, j % 6] = left
    return True
