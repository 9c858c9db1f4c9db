"""Distance to a target: what two ultra-wideband radios measure by the time of flight."""

import numpy as np

from coopenv.estimation.poses import Array
from coopenv.measurements.kinds import Kind, Placed, derivatives, unit


class Range(Kind):
    """Distance to a target, m."""

    rows = size = 1
    noise, units = (0.1,), ("m",)
    towards = ("vehicles", "anchors")

    def predict(self, own: Placed, target: Placed) -> Array:
        """Return distances (..., 1), m."""
        return unit(target.position - own.position)[1]

    def jacobian(self, own: Placed, target: Placed) -> tuple[Array, Array]:
        """Return the derivatives: the unit vector to the target, in map axes."""
        u, _ = unit(target.position - own.position)
        along = derivatives(None, np.asarray(u[..., None, :]))
        return -along, along
