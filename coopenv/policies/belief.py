"""How certain a vehicle would be of its pose after driving somewhere: planar covariances, rolled forward.

Extended Kalman filter with bearings to known landmarks. Source: Thrun, Burgard and Fox, Probabilistic Robotics, 2005,
3.3 and 7.5. What is measured does not matter, only from where, so the covariance of a plan is known beforehand;
Prentice and Roy, The belief roadmap, International Journal of Robotics Research 28, 2009. Measurements that may be
missing count by their odds; Sinopoli et al., Kalman filtering with intermittent observations, IEEE Transactions on
Automatic Control 49, 2004.
"""

from typing import NamedTuple

import numpy as np

LEAST_ODDS = 0.02  # below them a bearing counts as missing


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

    def along(self, offset: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return variances (..., K) of landmarks' bearing, rad^2, of their distance and of what is across it, m^2.

        Args:
            offset: (..., K, 2), m, from the vehicle to the landmarks.
        """
        distance = np.sqrt(np.maximum((offset**2).sum(axis=-1), 0.01))
        ux, uy = offset[..., 0] / distance, offset[..., 1] / distance
        xx, xy, xh, yy, yh, hh = (part[..., None] for part in self)
        radial = ux * ux * xx + 2.0 * ux * uy * xy + uy * uy * yy
        lateral = uy * uy * xx - 2.0 * ux * uy * xy + ux * ux * yy
        bearing = lateral / distance**2 + 2.0 * (ux * yh - uy * xh) / distance + hh
        return np.maximum(bearing, 1e-8), np.maximum(radial, 1e-8), np.maximum(lateral, 1e-8)

    def measured(self, offset: np.ndarray, variance: np.ndarray, odds: np.ndarray) -> "Belief":
        """Return the expected covariance after bearings to landmarks, any of which may be missing.

        One after the other, the covariance falls by the share `odds` of what the bearing would take off it.

        Args:
            offset: (..., K, 2), m, from the vehicle to the landmarks.
            variance: (..., K), rad^2, of each bearing.
            odds: (..., K), how likely it is had, in [0, 1].
        """
        shape = odds.shape[:-1]
        parts = np.stack([np.broadcast_to(part, shape).ravel() for part in self])
        count = odds.shape[-1]
        offset, variance, odds = offset.reshape(-1, count, 2), variance.reshape(-1, count), odds.reshape(-1, count)
        for k in range(count):
            rows = np.flatnonzero(odds[:, k] > LEAST_ODDS)
            if len(rows):
                own = Belief(*parts[:, rows])
                parts[:, rows] = own._with_bearing(offset[rows, k], variance[rows, k], odds[rows, k])
        return Belief(*(part.reshape(shape) for part in parts))

    def _with_bearing(self, offset: np.ndarray, variance: np.ndarray, odds: np.ndarray) -> tuple[np.ndarray, ...]:
        square = np.maximum((offset**2).sum(axis=-1), 0.01)
        gx, gy = offset[..., 1] / square, -offset[..., 0] / square  # of the bearing, which falls by 1 with the heading
        x = self.xx * gx + self.xy * gy - self.xh
        y = self.xy * gx + self.yy * gy - self.yh
        h = self.xh * gx + self.yh * gy - self.hh
        gain = odds / (gx * x + gy * y - h + variance)
        return (
            self.xx - gain * x * x,
            self.xy - gain * x * y,
            self.xh - gain * x * h,
            self.yy - gain * y * y,
            self.yh - gain * y * h,
            self.hh - gain * h * h,
        )

    def repeated(self, count: int) -> "Belief":
        """Return every entry (rows, P) so many times in a row, (rows, P count)."""
        return Belief(*(np.repeat(part, count, axis=1) for part in self))

    @property
    def std(self) -> np.ndarray:
        """Standard deviation of the position, (...), m: the root of the trace."""
        return np.asarray(np.sqrt(np.maximum(self.xx + self.yy, 0.0)))
