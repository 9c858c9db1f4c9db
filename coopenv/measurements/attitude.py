"""Orientation on the map: what a compass and an inclinometer measure together, or a level floor."""

from typing import Any

import numpy as np
import warp as wp

from coopenv.estimation.linalg import exp_so3
from coopenv.estimation.poses import Array
from coopenv.measurements.in_warp import first_three, joined, rotation_vector, rows_of
from coopenv.measurements.kinds import Kind, Placed, WarpFunctions, derivatives, exponential, logarithm


@wp.func
def predict_attitude(R: Any, p: Any, v: Any, target_R: Any, target_p: Any, target_v: Any, empty: Any):
    """Return the rotation vector to the map, rad."""
    return joined(rotation_vector(R, p), p - p, empty)


@wp.func
def sample_attitude(predicted: Any, noise: Any, like: Any):
    """Return the rotation vector of the orientation turned by the noise about the map's axes."""
    turned = exp_so3(first_three(noise, like)) * exp_so3(first_three(predicted, like))
    return joined(rotation_vector(turned, like), like - like, predicted)


@wp.func
def attitude_residual(value: Any, predicted: Any, like: Any):
    """Return the rotation vector, in map axes, from the predicted orientation to the measured one, rad."""
    turned = exp_so3(first_three(value, like)) * wp.transpose(exp_so3(first_three(predicted, like)))
    return joined(rotation_vector(turned, like), like - like, predicted)


@wp.func
def derive_attitude(R: Any, p: Any, v: Any, target_R: Any, target_p: Any, target_v: Any):
    """Return the derivatives: a turn about own axes is one about the map's by the rotation."""
    by_own = rows_of(R, R - R)
    return by_own, by_own - by_own


class Attitude(Kind):
    """Orientation of the sensor: the rotation vector to the map, rad.

    The noise turns about the map's axes: roll and pitch, then the heading. A large deviation leaves one of them out,
    so that a level floor is an attitude without a heading.
    """

    rows = size = 3
    has_target = False
    noise, units = (0.02, 0.02, 0.05), ("rad", "rad", "rad")
    towards = ("map",)
    in_warp = WarpFunctions(predict_attitude, sample_attitude, attitude_residual, derive_attitude)

    def predict(self, own: Placed, target: Placed) -> Array:
        """Return rotation vectors (..., 3), rad."""
        return logarithm(own.rotation)

    def residual(self, value: Array, predicted: Array) -> Array:
        """Return (..., 3) rad: the rotation vector, in map axes, from the predicted orientation to the measured one."""
        return logarithm(exponential(value) @ np.swapaxes(exponential(predicted), -1, -2))

    def jacobian(self, own: Placed, target: Placed) -> tuple[Array, Array]:
        """Return the derivatives: a turn about own axes is one about the map's by the rotation."""
        by_own = derivatives(own.rotation, np.zeros_like(own.rotation))
        return by_own, np.zeros_like(by_own)

    def sample(self, predicted: Array, noise: Array) -> Array:
        """Return the rotation vectors of orientations turned by the noise about the map's axes."""
        return logarithm(exponential(noise) @ exponential(predicted))
