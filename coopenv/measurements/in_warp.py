"""Warp functions that kinds share, generic in the precision; a value has six numbers, zero beyond its size."""

from typing import Any

import warp as wp

from coopenv.estimation.linalg import join6, quaternion_vector, rotation_vector_sine


@wp.func
def joined(first: Any, last: Any, empty: Any):
    """Return the six numbers of two vectors of three; `empty` has the type of the result."""
    return type(empty)(first[0], first[1], first[2], last[0], last[1], last[2])


@wp.func
def first_three(value: Any, like: Any):
    """Return the first three of six numbers, in the type of the vector `like`."""
    return type(like)(value[0], value[1], value[2])


@wp.func
def last_three(value: Any, like: Any):
    """Return the last three of six numbers, in the type of the vector `like`."""
    return type(like)(value[3], value[4], value[5])


@wp.func
def rotation_vector(R: Any, like: Any):
    """Return the rotation vector of R, of length 0..pi rad, in the type of the vector `like`."""
    q = quaternion_vector(R)
    half_sine = wp.length(q)  # sine of half the angle
    one = R.dtype(1.0)
    factor = one + one
    if half_sine > R.dtype(1.0e-12):
        half_cosine = wp.length(rotation_vector_sine(R)) / (factor * half_sine)  # accurate near half a turn
        if half_sine < R.dtype(0.7):
            half_cosine = wp.sqrt(one - half_sine * half_sine)
        factor = factor * wp.atan2(half_sine, half_cosine) / half_sine
    return type(like)(q[0] * factor, q[1] * factor, q[2] * factor)


@wp.func
def rows_of(turn: Any, shift: Any):
    """Return the derivative (6, 6) of three rows, by a turn (3, 3) and a shift (3, 3); the last rows are zero."""
    return join6(turn, shift, turn - turn, turn - turn)


@wp.func
def first_row(a: Any):
    """Return a matrix (3, 3) of zeros with a first row."""
    return wp.matrix_from_rows(a, a - a, a - a)


@wp.func
def excess(value: Any, predicted: Any, like: Any):
    """Return by how much six measured numbers exceed predicted ones."""
    return value - predicted


@wp.func
def plus_noise(predicted: Any, noise: Any, like: Any):
    """Return the sum of six predicted numbers and their noise."""
    return predicted + noise
