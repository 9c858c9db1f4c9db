"""A body on a smooth path in the plane, known at any time in closed form: what assemblers of samples are tried on."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

SPEED, TURN, WIGGLE = 0.4, 0.5, 2.0
"""m/s, rad and rad/s: heading(t) = TURN sin(WIGGLE t), at constant speed."""
STEPS = 2000


class Path:
    """Pose and twist at any time t in s; it starts at the origin, heading along x."""

    def __init__(self, until: float) -> None:
        """Integrate the position finely, by Simpson's rule."""
        self._t = np.linspace(0.0, until, 2 * STEPS + 1)
        heading = self.heading(self._t)
        x, y = (self._integral(SPEED * f(heading)) for f in (np.cos, np.sin))
        self._places = np.stack([x, y], axis=-1)

    def _integral(self, values: np.ndarray) -> np.ndarray:
        h = self._t[1] - self._t[0]
        middle = h / 3.0 * (values[:-2:2] + 4.0 * values[1:-1:2] + values[2::2])
        return np.interp(self._t, self._t[::2], np.concatenate([[0.0], np.cumsum(middle)]))

    @staticmethod
    def heading(t: np.ndarray | float) -> np.ndarray:
        return np.asarray(TURN * np.sin(WIGGLE * np.asarray(t)))

    def pose(self, t: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the rotation (3, 3) and position (3,) at a time."""
        x, y = (np.interp(t, self._t, column) for column in self._places.T)
        return Rotation.from_euler("z", float(self.heading(t))).as_matrix(), np.array([x, y, 0.0])

    @staticmethod
    def twist(t: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the velocity, m/s, and angular velocity, rad/s, in the body."""
        return np.array([SPEED, 0.0, 0.0]), np.array([0.0, 0.0, TURN * WIGGLE * np.cos(WIGGLE * t)])
