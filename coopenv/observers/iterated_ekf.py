"""Iterated extended Kalman filter, with the neighbours' covariance as measurement noise.

Source: Bell and Cathey, The iterated Kalman filter update as a Gauss-Newton method, IEEE Transactions on Automatic
Control 38(2), 1993: every correction is iterated to the most probable pose given the prediction and the frame. Errors
and Jacobians as in mekf.py. Being linearised at the end and not half way, it has the drift of ranges that
correction.py tells of, inwards.
"""

import numpy as np

from coopenv.estimation.arrays import Array
from coopenv.estimation.rotations import lengths
from coopenv.observers.contract import Tick
from coopenv.observers.correction import Stacked, iterated, turn_of_sight
from coopenv.observers.lines import Sight, linearised
from coopenv.observers.mekf_covariance import MekfCovariance


class IteratedEkf(MekfCovariance):
    """Error-state filter that iterates corrections; sends covariances."""

    def fuse(self, tick: Tick, sight: Sight) -> float:
        """Correct by bearings, linearised anew until the pose stays where it is; return what `Mekf.fuse` does."""
        before, distance = self.state, float(lengths(sight.positions - self.state.p).min())

        def look(at: Array) -> Stacked:
            residual, H, N = linearised(before.moved(at, before.P), tick, sight).stacked()
            return residual, H.dot(before.recentring(at)), N

        dx, P, nis = iterated(before.P, look(np.zeros(6)), look, lambda dx: turn_of_sight(dx, distance))
        self.state = before.corrected(dx, P)
        return nis
