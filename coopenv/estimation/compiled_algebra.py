"""Small matrices and rotations for compiled functions: up to about ten rows BLAS takes longer.

LAPACK by way of Numba is no slower, but takes seconds to compile in every function that uses it.
"""

import numpy as np

from coopenv.estimation import poses
from coopenv.estimation.compiled import MATRIX, TARGET, VECTOR, WHOLE, compiled
from coopenv.estimation.poses import Array


@compiled(TARGET, WHOLE, WHOLE, MATRIX)
def place(M: Array, row: int, column: int, block: Array) -> None:
    """Write a block into a matrix: Numba takes long to compile assignments to slices."""
    for i in range(block.shape[0]):
        for j in range(block.shape[1]):
            M[row + i, column + j] = block[i, j]


@compiled(MATRIX, MATRIX)
def product(A: Array, B: Array) -> Array:
    """Return A B (n, k) of A (n, m) and B (m, k)."""
    (n, m), k = A.shape, B.shape[1]
    C = np.zeros((n, k))
    for i in range(n):
        for j in range(m):
            for l in range(k):  # noqa: E741
                C[i, l] += A[i, j] * B[j, l]
    return C


@compiled(MATRIX, VECTOR)
def transformed(A: Array, x: Array) -> Array:
    """Return A x (n,) of A (n, m) and x (m,)."""
    y = np.zeros(len(A))
    for i in range(len(A)):
        for j in range(len(x)):
            y[i] += A[i, j] * x[j]
    return y


@compiled(MATRIX, MATRIX)
def congruent(A: Array, P: Array) -> Array:
    """Return A P A^T (n, n) of A (n, m) and P (m, m)."""
    return product(product(A, P), A.T)


@compiled(MATRIX, MATRIX)
def eliminated(A: Array, B: Array) -> Array:
    """Return A^-1 B (n, k), by Gaussian elimination with pivots; a LinAlgError means that A (n, n) is singular."""
    A, X, n = A.copy(), B.copy(), len(A)
    for k in range(n):
        pivot = k + np.argmax(np.abs(A[k:, k]))
        if A[pivot, k] == 0.0:
            raise np.linalg.LinAlgError("singular matrix")
        for j in range(n):
            A[k, j], A[pivot, j] = A[pivot, j], A[k, j]
        for j in range(X.shape[1]):
            X[k, j], X[pivot, j] = X[pivot, j], X[k, j]
        for i in range(k + 1, n):
            factor = A[i, k] / A[k, k]
            for j in range(k + 1, n):
                A[i, j] -= factor * A[k, j]
            for j in range(X.shape[1]):
                X[i, j] -= factor * X[k, j]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            for j in range(X.shape[1]):
                X[i, j] -= A[i, k] * X[k, j]
        for j in range(X.shape[1]):
            X[i, j] /= A[i, i]
    return X


exp_so3 = compiled(VECTOR)(poses.exp_so3)
right_jacobian = compiled(VECTOR)(poses.right_jacobian)
exp_translation = compiled(VECTOR, VECTOR)(poses.exp_translation)


@compiled(MATRIX)
def orthonormalised(R: Array) -> Array:
    """Return the rotation nearest to an almost orthogonal R (3, 3), see `poses.orthonormalise`."""
    return 1.5 * R - product(0.5 * R, product(R.T, R))


@compiled(VECTOR)
def cross_matrix(v: Array) -> Array:
    """Return S(v) (3, 3) with S(v) y = v x y."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
