"""Distance to a target: what two ultra-wideband radios measure by the time of flight."""

from typing import Any

import numpy as np
import warp as wp

from coopenv.estimation.poses import Array
from coopenv.measurements.in_warp import excess, first_row, plus_noise, rows_of
from coopenv.measurements.kinds import Kind, Placed, WarpFunctions, derivatives, unit


@wp.func
def predict_range(R: Any, p: Any, v: Any, target_R: Any, target_p: Any, target_v: Any, empty: Any):
    """Return the distance, m."""
    o = empty.dtype(0.0)
    return type(empty)(wp.length(target_p - p), o, o, o, o, o)


@wp.func
def derive_range(R: Any, p: Any, v: Any, target_R: Any, target_p: Any, target_v: Any):
    """Return the derivatives by the sensor and by the target: the unit vector to the target, in map axes."""
    along = first_row(wp.normalize(target_p - p))
    return rows_of(R - R, -along), rows_of(R - R, along)


class Range(Kind):
    """Distance to a target, m."""

    rows = size = 1
    noise, units = (0.1,), ("m",)
    towards = ("vehicles", "anchors")
    in_warp = WarpFunctions(predict_range, plus_noise, excess, derive_range)

    def predict(self, own: Placed, target: Placed) -> Array:
        """Return distances (..., 1), m."""
        return unit(target.position - own.position)[1]

    def jacobian(self, own: Placed, target: Placed) -> tuple[Array, Array]:
        """Return the derivatives: the unit vector to the target, in map axes."""
        u, _ = unit(target.position - own.position)
        along = derivatives(None, np.asarray(u[..., None, :]))
        return -along, along
