"""Iterated extended Kalman filter, with the neighbours' covariance as measurement noise.

Source: Bell and Cathey, The iterated Kalman filter update as a Gauss-Newton method, IEEE Transactions on Automatic
Control 38(2), 1993: every correction is iterated to the most probable pose given the prediction and the frame. Errors
and Jacobians as in mekf.py. Being linearised at the end and not half way, it has the drift of ranges that
correction.py tells of, inwards.
"""

from coopenv.estimation.arrays import Array
from coopenv.estimation.rotations import lengths
from coopenv.observers.correction import Look, Stacked, iterated, turn_of_sight
from coopenv.observers.lines import Sight
from coopenv.observers.mekf_covariance import MekfCovariance


class IteratedEkf(MekfCovariance):
    """Error-state filter that iterates corrections; sends covariances."""

    def settled(self, P: Array, first: Stacked, look: Look, sight: Sight) -> tuple[Array, Array, float]:
        """Return the correction (n,), the covariance (n, n) after it and r^T S^-1 r at the prediction.

        The update is linearised anew until it stays where it is.
        """
        distance = float(lengths(sight.positions - self.state.p).min())
        return iterated(P, first, look, lambda dx: turn_of_sight(dx, distance))
