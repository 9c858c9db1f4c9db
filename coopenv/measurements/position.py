"""Position on the map: what a receiver of navigation satellites measures, in the map's axes."""

import numpy as np

from coopenv.estimation.poses import Array
from coopenv.measurements.kinds import Kind, Placed, derivatives


class Position(Kind):
    """Position of the antenna, m."""

    rows = size = 3
    has_target = False
    noise, units = (1.0, 1.0, 2.0), ("m", "m", "m")
    towards = ("map",)

    def predict(self, own: Placed, target: Placed) -> Array:
        """Return positions (..., 3) of the antenna, map, m."""
        return own.position

    def jacobian(self, own: Placed, target: Placed) -> tuple[Array, Array]:
        """Return the derivatives: the identity by the antenna's shift."""
        by_own = derivatives(None, np.broadcast_to(np.eye(3), (*own.position.shape, 3)))
        return by_own, np.zeros_like(by_own)
