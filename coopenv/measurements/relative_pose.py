"""Pose of a target in the sensor's axes: what a camera measures of a tag, or of a vehicle of known shape."""

from typing import Any

import numpy as np
import warp as wp

from coopenv.estimation import linalg
from coopenv.estimation.linalg import exp_so3, identity3, join6
from coopenv.estimation.poses import Array, skew
from coopenv.measurements.in_warp import first_three, joined, last_three, rotation_vector
from coopenv.measurements.kinds import (
    Kind,
    Placed,
    WarpFunctions,
    derivatives,
    exponential,
    in_axes,
    logarithm,
)


@wp.func
def predict_relative_pose(R: Any, p: Any, v: Any, target_R: Any, target_p: Any, target_v: Any, empty: Any):
    """Return the target's position, m, and rotation vector, rad, in the sensor's axes."""
    to_own = wp.transpose(R)
    return joined(to_own * (target_p - p), rotation_vector(to_own * target_R, p), empty)


@wp.func
def sample_relative_pose(predicted: Any, noise: Any, like: Any):
    """Return the shifted position and the orientation turned by the noise."""
    turned = exp_so3(last_three(noise, like)) * exp_so3(last_three(predicted, like))
    place = first_three(predicted, like) + first_three(noise, like)
    return joined(place, rotation_vector(turned, like), predicted)


@wp.func
def relative_pose_residual(value: Any, predicted: Any, like: Any):
    """Return m, and the rotation vector from the predicted orientation to the measured one, rad."""
    turned = exp_so3(last_three(value, like)) * wp.transpose(exp_so3(last_three(predicted, like)))
    return joined(first_three(value - predicted, like), rotation_vector(turned, like), predicted)


@wp.func
def derive_relative_pose(R: Any, p: Any, v: Any, target_R: Any, target_p: Any, target_v: Any):
    """Return the derivatives, see `RelativePose.jacobian`."""
    to_own = wp.transpose(R)
    zero = R - R
    turn = linalg.skew(to_own * (target_p - p))
    return join6(turn, -to_own, -identity3(p), zero), join6(zero, to_own, to_own * target_R, zero)


class RelativePose(Kind):
    """Position of a target, m, and its orientation, a rotation vector in rad, both in the sensor's axes."""

    rows = size = 6
    noise, units = (0.05,) * 3 + (0.02,) * 3, ("m",) * 3 + ("rad",) * 3
    needs = ("rotation",)
    in_warp = WarpFunctions(predict_relative_pose, sample_relative_pose, relative_pose_residual, derive_relative_pose)
    parts = (("position", 3, "m"), ("turn", 3, "rad"))

    def predict(self, own: Placed, target: Placed) -> Array:
        """Return (..., 6): position, m, and rotation vector, rad, NaN if the target's orientation is not known."""
        turned = np.swapaxes(own.rotation, -1, -2) @ target.rotation
        return np.concatenate([in_axes(own.rotation, target.position - own.position), logarithm(turned)], axis=-1)

    def residual(self, value: Array, predicted: Array) -> Array:
        """Return (..., 6): m, and the rotation vector from the predicted orientation to the measured one, rad."""
        turned = exponential(value[..., 3:]) @ np.swapaxes(exponential(predicted[..., 3:]), -1, -2)
        return np.concatenate([value[..., :3] - predicted[..., :3], logarithm(turned)], axis=-1)

    def jacobian(self, own: Placed, target: Placed) -> tuple[Array, Array]:
        """Return the derivatives: those of a = R^T (z - p) are S(a) by a turn and R^T by a shift of the target."""
        to_own = np.swapaxes(own.rotation, -1, -2)
        a, zero = in_axes(own.rotation, target.position - own.position), np.zeros_like(to_own)
        place = derivatives(skew(a), -to_own), derivatives(None, to_own)
        turn = derivatives(zero - np.eye(3), zero), derivatives(to_own @ target.rotation, zero)
        by_own, by_target = (np.concatenate(rows, axis=-2) for rows in zip(place, turn, strict=True))
        return by_own, by_target

    def sample(self, predicted: Array, noise: Array) -> Array:
        """Return shifted positions and orientations turned by the noise, both in the sensor's axes."""
        turned = exponential(noise[..., 3:]) @ exponential(predicted[..., 3:])
        return np.concatenate([predicted[..., :3] + noise[..., :3], logarithm(turned)], axis=-1)
