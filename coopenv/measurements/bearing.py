"""Direction to a target, a unit vector in the sensor's axes: what a camera measures."""

from typing import Any

import numpy as np
import warp as wp

from coopenv.estimation import linalg
from coopenv.estimation.poses import Array, skew
from coopenv.measurements.in_warp import first_three, joined, rows_of
from coopenv.measurements.kinds import Kind, Placed, WarpFunctions, derivatives, in_axes, unit


def across(u: Array) -> Array:
    """Return orthonormal rows (..., 2, 3) across unit vectors (..., 3).

    Source: Duff et al., Building an orthonormal basis, revisited, Journal of Computer Graphics Techniques 6(1), 2017.
    """
    x, y, z = np.moveaxis(u, -1, 0)
    sign = np.copysign(1.0, z)
    a = -1.0 / (sign + z)
    c = x * y * a
    first = np.stack([1.0 + sign * x * x * a, sign * c, -sign * x], axis=-1)
    return np.stack([first, np.stack([c, sign + y * y * a, -y], axis=-1)], axis=-2)


@wp.func
def predict_bearing(R: Any, p: Any, v: Any, target_R: Any, target_p: Any, target_v: Any, empty: Any):
    """Return the unit vector to the target in the sensor's axes."""
    return joined(wp.normalize(wp.transpose(R) * (target_p - p)), p - p, empty)


@wp.func
def axes_across(u: Any):
    """Return two orthonormal vectors across a unit vector, see `across`."""
    one = u.dtype(1.0)
    sign = wp.where(u[2] < u.dtype(0.0), -one, one)
    a = -one / (sign + u[2])
    c = u[0] * u[1] * a
    first = type(u)(one + sign * u[0] * u[0] * a, sign * c, -sign * u[0])
    return first, type(u)(c, sign + u[1] * u[1] * a, -u[1])


@wp.func
def sample_bearing(predicted: Any, noise: Any, like: Any):
    """Return the unit vector moved in its tangent plane."""
    u = first_three(predicted, like)
    first, second = axes_across(u)
    return joined(wp.normalize(u + noise[0] * first + noise[1] * second), like - like, predicted)


@wp.func
def bearing_residual(value: Any, predicted: Any, like: Any):
    """Return the value in the tangent plane of the predicted direction, rad."""
    first, second = axes_across(first_three(predicted, like))
    measured = first_three(value, like)
    return joined(type(like)(wp.dot(first, measured), wp.dot(second, measured), like.dtype(0.0)), like - like, value)


@wp.func
def derive_bearing(R: Any, p: Any, v: Any, target_R: Any, target_p: Any, target_v: Any):
    """Return the derivatives in the tangent plane, see `Bearing.line`."""
    d = wp.transpose(R) * (target_p - p)
    u = wp.normalize(d)
    first, second = axes_across(u)
    plane = wp.matrix_from_rows(first, second, u - u)
    shift = (plane * wp.transpose(R)) / wp.max(wp.length(d), d.dtype(1.0e-9))
    return rows_of(plane * linalg.skew(u), -shift), rows_of(R - R, shift)


class Bearing(Kind):
    """Direction to a target."""

    rows, size = 2, 3
    noise, units = (2.9e-3, 2.9e-3), ("rad", "rad")
    in_warp = WarpFunctions(predict_bearing, sample_bearing, bearing_residual, derive_bearing)
    parts = (("", 3, "1"),)

    def predict(self, own: Placed, target: Placed) -> Array:
        """Return unit vectors (..., 3) from the sensor to the target, the sensor's axes."""
        return unit(in_axes(own.rotation, target.position - own.position))[0]

    def residual(self, value: Array, predicted: Array) -> Array:
        """Return (..., 2) rad: the value in the tangent plane of the predicted direction."""
        return np.asarray((across(predicted) @ value[..., None])[..., 0])

    def jacobian(self, own: Placed, target: Placed) -> tuple[Array, Array]:
        """Return the derivatives in the tangent plane."""
        u, D_own, D_target = self.line(own, target)
        B = across(u)
        return B @ D_own, B @ D_target

    def line(self, own: Placed, target: Placed) -> tuple[Array, Array, Array]:
        """Return u (..., 3) and its derivatives (..., 3, 6) by errors of the sensor and of the target.

        A turn theta takes u to u + u x theta; a shift of the target moves u across itself, by 1 / distance.
        """
        u, distance = unit(in_axes(own.rotation, target.position - own.position))
        plane = (np.eye(3) - u[..., :, None] * u[..., None, :]) / distance[..., None]
        shift = plane @ np.swapaxes(own.rotation, -1, -2)
        return u, derivatives(skew(u), -shift), derivatives(None, shift)

    def sample(self, predicted: Array, noise: Array) -> Array:
        """Return unit vectors: predicted ones moved in their tangent planes."""
        return unit(predicted + (np.swapaxes(across(predicted), -1, -2) @ noise[..., None])[..., 0])[0]
