"""Direction and distance to a target: what a camera measures by the size of a known mark, or a lidar."""

from typing import Any

import numpy as np
import warp as wp

from coopenv.estimation.poses import Array
from coopenv.measurements.bearing import Bearing, bearing_residual, derive_bearing, predict_bearing, sample_bearing
from coopenv.measurements.kinds import Kind, Placed, WarpFunctions
from coopenv.measurements.range import Range, derive_range

BEARING, RANGE = Bearing(), Range()


@wp.func
def predict_range_bearing(R: Any, p: Any, v: Any, target_R: Any, target_p: Any, target_v: Any, empty: Any):
    """Return the unit vector in the sensor's axes and the distance, m."""
    value = predict_bearing(R, p, v, target_R, target_p, target_v, empty)
    value[3] = wp.length(target_p - p)
    return value


@wp.func
def sample_range_bearing(predicted: Any, noise: Any, like: Any):
    """Return the parts with their noise."""
    value = sample_bearing(predicted, noise, like)
    value[3] = predicted[3] + noise[2]
    return value


@wp.func
def range_bearing_residual(value: Any, predicted: Any, like: Any):
    """Return rad, rad, m."""
    rows = bearing_residual(value, predicted, like)
    rows[2] = value[3] - predicted[3]
    return rows


@wp.func
def derive_range_bearing(R: Any, p: Any, v: Any, target_R: Any, target_p: Any, target_v: Any):
    """Return the derivatives of both parts."""
    by_own, by_target = derive_bearing(R, p, v, target_R, target_p, target_v)
    of_range, of_range_by_target = derive_range(R, p, v, target_R, target_p, target_v)
    by_own[2] = of_range[0]
    by_target[2] = of_range_by_target[0]
    return by_own, by_target


class RangeBearing(Kind):
    """Direction to a target, a unit vector, and its distance, m."""

    rows, size = 3, 4
    noise, units = (*BEARING.noise, *RANGE.noise), (*BEARING.units, *RANGE.units)
    in_warp = WarpFunctions(predict_range_bearing, sample_range_bearing, range_bearing_residual, derive_range_bearing)
    parts = (("direction", 3, "1"), ("distance", 1, "m"))

    def predict(self, own: Placed, target: Placed) -> Array:
        """Return (..., 4): the unit vector in the sensor's axes and the distance, m."""
        return np.concatenate([part.predict(own, target) for part in (BEARING, RANGE)], axis=-1)

    def residual(self, value: Array, predicted: Array) -> Array:
        """Return (..., 3): rad, rad, m."""
        direction = BEARING.residual(value[..., :3], predicted[..., :3])
        return np.concatenate([direction, value[..., 3:] - predicted[..., 3:]], axis=-1)

    def jacobian(self, own: Placed, target: Placed) -> tuple[Array, Array]:
        """Return the derivatives of both parts."""
        parts = [part.jacobian(own, target) for part in (BEARING, RANGE)]
        by_own, by_target = (np.concatenate(rows, axis=-2) for rows in zip(*parts, strict=True))
        return by_own, by_target

    def sample(self, predicted: Array, noise: Array) -> Array:
        """Return the parts with their noise."""
        direction = BEARING.sample(predicted[..., :3], noise[..., :2])
        return np.concatenate([direction, predicted[..., 3:] + noise[..., 2:]], axis=-1)
