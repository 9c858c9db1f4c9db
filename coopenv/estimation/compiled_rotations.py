"""Rotations and their derivatives for compiled functions."""

import numpy as np

from coopenv.estimation import rotations
from coopenv.estimation.arrays import Array
from coopenv.estimation.compiled import MATRIX, VECTOR, compiled
from coopenv.estimation.compiled_matrices import product

exp_so3 = compiled(VECTOR)(rotations.exp_so3)
right_jacobian = compiled(VECTOR)(rotations.right_jacobian)
exp_translation = compiled(VECTOR, VECTOR)(rotations.exp_translation)


@compiled(MATRIX)
def orthonormalised(R: Array) -> Array:
    """Return the rotation nearest to an almost orthogonal R (3, 3), see `rotations.orthonormalise`."""
    return 1.5 * R - product(0.5 * R, product(R.T, R))


@compiled(VECTOR)
def cross_matrix(v: Array) -> Array:
    """Return S(v) (3, 3) with S(v) y = v x y."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
