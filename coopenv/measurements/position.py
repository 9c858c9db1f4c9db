"""Position on the map: what a receiver of navigation satellites measures, in the map's axes."""

from typing import Any

import numpy as np
import warp as wp

from coopenv.estimation.linalg import identity3
from coopenv.estimation.poses import Array
from coopenv.measurements.in_warp import excess, joined, plus_noise, rows_of
from coopenv.measurements.kinds import Kind, Placed, WarpFunctions, derivatives


@wp.func
def predict_position(R: Any, p: Any, v: Any, target_R: Any, target_p: Any, target_v: Any, empty: Any):
    """Return the position of the antenna, map, m."""
    return joined(p, p - p, empty)


@wp.func
def derive_position(R: Any, p: Any, v: Any, target_R: Any, target_p: Any, target_v: Any):
    """Return the derivatives: the identity by the antenna's shift, and zero."""
    by_own = rows_of(R - R, identity3(p))
    return by_own, by_own - by_own


class Position(Kind):
    """Position of the antenna, m."""

    rows = size = 3
    has_target = False
    noise, units = (1.0, 1.0, 2.0), ("m", "m", "m")
    towards = ("map",)
    drawn = "cross"
    under_sky = True
    in_warp = WarpFunctions(predict_position, plus_noise, excess, derive_position)

    def predict(self, own: Placed, target: Placed) -> Array:
        """Return positions (..., 3) of the antenna, map, m."""
        return own.position

    def jacobian(self, own: Placed, target: Placed) -> tuple[Array, Array]:
        """Return the derivatives: the identity by the antenna's shift."""
        by_own = derivatives(None, np.broadcast_to(np.eye(3), (*own.position.shape, 3)))
        return by_own, np.zeros_like(by_own)
