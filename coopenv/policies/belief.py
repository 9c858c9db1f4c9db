"""How certain a vehicle would be of its pose after driving somewhere: planar covariances, rolled forward.

Extended Kalman filter with bearings to known landmarks, in information form. Source: Thrun, Burgard and Fox,
Probabilistic Robotics, 2005, 3.3, 3.5 and 7.5. What is measured does not matter, only from where, so the covariance of
a plan is known beforehand; Prentice and Roy, The belief roadmap, International Journal of Robotics Research 28, 2009.
"""

from typing import NamedTuple

import numpy as np


class Belief(NamedTuple):
    """Entries (...) of the covariance of x, y (m) and heading (rad), in any fixed frame."""

    xx: np.ndarray
    xy: np.ndarray
    xh: np.ndarray
    yy: np.ndarray
    yh: np.ndarray
    hh: np.ndarray

    def driven(self, dx: np.ndarray, dy: np.ndarray, drift: float, turn_drift: float) -> "Belief":
        """Return the covariance after a motion by (dx, dy), m, along which the error grew.

        Args:
            dx: (...), m.
            dy: (...), m.
            drift: m^2, growth of the variance per axis.
            turn_drift: rad^2, growth of the heading's variance.
        """
        return Belief(
            xx=self.xx - 2.0 * dy * self.xh + dy * dy * self.hh + drift,
            xy=self.xy + dx * self.xh - dy * self.yh - dx * dy * self.hh,
            xh=self.xh - dy * self.hh,
            yy=self.yy + 2.0 * dx * self.yh + dx * dx * self.hh + drift,
            yh=self.yh + dx * self.hh,
            hh=self.hh + turn_drift,
        )

    def measured(self, offset: np.ndarray, weight: np.ndarray) -> "Belief":
        """Return the covariance after bearings to landmarks.

        Args:
            offset: (..., K, 2), m, from the vehicle to the landmarks.
            weight: (..., K), rad^-2, information of each bearing; 0: not in view.
        """
        square = np.maximum((offset**2).sum(axis=-1), 0.01)
        gx, gy = offset[..., 1] / square, -offset[..., 0] / square  # of the bearing, which falls by 1 with the heading
        own = self.inverse()
        return Belief(
            xx=own.xx + (weight * gx * gx).sum(axis=-1),
            xy=own.xy + (weight * gx * gy).sum(axis=-1),
            xh=own.xh - (weight * gx).sum(axis=-1),
            yy=own.yy + (weight * gy * gy).sum(axis=-1),
            yh=own.yh - (weight * gy).sum(axis=-1),
            hh=own.hh + weight.sum(axis=-1),
        ).inverse()

    def inverse(self) -> "Belief":
        """Return the inverse matrix."""
        xx = self.yy * self.hh - self.yh * self.yh
        xy = self.xh * self.yh - self.xy * self.hh
        xh = self.xy * self.yh - self.xh * self.yy
        determinant = np.maximum(self.xx * xx + self.xy * xy + self.xh * xh, 1e-30)
        yy, yh = self.xx * self.hh - self.xh * self.xh, self.xy * self.xh - self.xx * self.yh
        hh = self.xx * self.yy - self.xy * self.xy
        return Belief(*(part / determinant for part in (xx, xy, xh, yy, yh, hh)))

    @property
    def std(self) -> np.ndarray:
        """Standard deviation of the position, (...), m: the root of the trace."""
        return np.asarray(np.sqrt(np.maximum(self.xx + self.yy, 0.0)))
