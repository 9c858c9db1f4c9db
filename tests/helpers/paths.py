"""A body on a smooth path in the plane, known at any time in closed form: what assemblers of samples are tried on."""

from __future__ import annotations

import numpy as np
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

SPEED, TURN, WIGGLE = 0.4, 0.5, 2.0
"""m/s, rad and rad/s: heading(t) = TURN sin(WIGGLE t), at constant speed."""


class Path:
    """Pose and twist at any time t in s; it starts at the origin, heading along x."""

    def __init__(self, until: float) -> None:
        def velocity(t: float, _: np.ndarray) -> np.ndarray:
            return SPEED * np.array([np.cos(self.heading(t)), np.sin(self.heading(t))])

        self._place = solve_ivp(velocity, (0.0, until), [0.0, 0.0], rtol=1e-10, atol=1e-12, dense_output=True).sol

    @staticmethod
    def heading(t: np.ndarray | float) -> np.ndarray:
        return np.asarray(TURN * np.sin(WIGGLE * np.asarray(t)))

    def pose(self, t: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the rotation (3, 3) and position (3,) at a time."""
        return Rotation.from_euler("z", float(self.heading(t))).as_matrix(), np.append(self._place(t), 0.0)

    @staticmethod
    def twist(t: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the velocity, m/s, and angular velocity, rad/s, in the body."""
        return np.array([SPEED, 0.0, 0.0]), np.array([0.0, 0.0, TURN * WIGGLE * np.cos(WIGGLE * t)])
