"""The response of a robot's wheels to its commands, as it was measured on the robots of MR.CLAM."""

from dataclasses import dataclass

import numpy as np

TURNING_RATE = 1e-6  # rad/s; a smaller command is one to drive straight
DRIVING_SPEED = 1e-6  # m/s; a smaller command is one to turn on the spot


@dataclass(frozen=True, slots=True)
class Wheels:
    """Response of a kind of robot to its commands v and w; by default it is immediate."""

    delay: tuple[float, ...] = (0.0,)  # s after the lead by which commands are early
    share: tuple[float, ...] = (1.0,)  # of the response at these delays; they sum to one
    arc: tuple[tuple[float, float], ...] = ((0.0, 1.0),)
    """(curvature |w| / v in 1/m, gain): turn over commanded turn, linear between and beyond."""
    spot: float = 1.0  # the same gain of turns on the spot
    slow: float = 0.0  # m/s, below which arcs tighter than 1/m gain more, by:
    slow_gain: float = 0.0
    centre: float = 0.0  # rad/s, the logged w at which it drives straight, for the curvature

    def gain(self, v: float, w: float) -> float:
        """Return turn against commanded turn at v in m/s and w in rad/s."""
        if abs(v) <= DRIVING_SPEED:
            return self.spot
        curvature = abs(w - self.centre) / abs(v)
        curvatures, gains = zip(*self.arc, strict=True)
        more = self.slow_gain if abs(v) < self.slow and curvature > 1.0 else 0.0
        return float(np.interp(curvature, curvatures, gains)) + more


IROBOT_CREATE = Wheels(
    delay=(0.0, 0.1, 0.2, 0.4),
    share=(0.33, 0.42, 0.16, 0.09),
    arc=((0.15, 1.8), (0.35, 1.3), (0.8, 0.88), (1.6, 0.84), (2.6, 0.8), (3.2, 0.95), (3.8, 1.1), (4.5, 0.975)),
    spot=1.03,
    slow=0.065,
    slow_gain=0.22,
    centre=0.005,
)
"""The iRobot Create of MR.CLAM, measured on sub-dataset 6; all of its robots agree (docs/data.md)."""
