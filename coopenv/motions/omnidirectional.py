"""The omnidirectional drive (mecanum or omni wheels): speed forwards, turn rate, and speed to the left.

Odometry measures the body twist: the wheels both speeds, the gyro the yaw rate.
"""

from typing import Any

import warp as wp


@wp.func
def displacement(d: Any, forward: Any, turn: Any, lateral: Any, dt: Any, like: Any):
    """Return the way (m) and the turn (rad) of the body, body frame, see `coopenv.motions.dispatch`."""
    o = type(like)()
    return type(like)(forward, lateral, o[2]), type(like)(o[0], o[1], turn * dt)
