"""Warp types in float64, and the joint 6x6 blocks made of 3x3 ones."""

from typing import Any

import warp as wp

vec2d: Any = wp.vec2d
vec3d: Any = wp.vec3d
mat22d: Any = wp.mat22d
mat33d: Any = wp.mat33d
vec6d: Any = wp.types.vector(6, wp.float64)
mat23d: Any = wp.types.matrix((2, 3), wp.float64)
mat26d: Any = wp.types.matrix((2, 6), wp.float64)
mat62d: Any = wp.types.matrix((6, 2), wp.float64)
mat43d: Any = wp.types.matrix((4, 3), wp.float64)
mat66d: Any = wp.types.matrix((6, 6), wp.float64)
mat66f: Any = wp.types.matrix((6, 6), wp.float32)


@wp.func
def wide_vector(v: Any):
    """Return a 3-vector in float64."""
    return vec3d(wp.float64(v[0]), wp.float64(v[1]), wp.float64(v[2]))


@wp.func
def wide_matrix(M: Any):
    """Return a 3x3 matrix in float64."""
    result = mat33d()
    for i in range(3):
        for j in range(3):
            result[i, j] = wp.float64(M[i, j])
    return result


@wp.func
def first_half(x: Any):
    """Return the rotational part of an error."""
    return vec3d(x[0], x[1], x[2])


@wp.func
def second_half(x: Any):
    """Return the translational part of an error."""
    return vec3d(x[3], x[4], x[5])


@wp.func
def stacked(a: Any, b: Any):
    """Return the error (a, b)."""
    return vec6d(a[0], a[1], a[2], b[0], b[1], b[2])


@wp.func
def beside(A: Any, B: Any):
    """Return the 2x6 matrix [A, B]."""
    M = mat26d()
    for i in range(2):
        for j in range(3):
            M[i, j] = A[i, j]
            M[i, j + 3] = B[i, j]
    return M


@wp.func
def lower_blocks(A: Any, C: Any, D: Any):
    """Return the 6x6 matrix [[A, 0], [C, D]]."""
    M = mat66d()
    for i in range(3):
        for j in range(3):
            M[i, j] = A[i, j]
            M[i + 3, j] = C[i, j]
            M[i + 3, j + 3] = D[i, j]
    return M
