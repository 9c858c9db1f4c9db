"""The kinematic bicycle: speed and steering angle; its reference point is the middle of the rear axle.

Odometry measures the body twist: the wheels the forward speed, the gyro the yaw rate.
"""

from typing import Any

import warp as wp


@wp.func
def displacement(d: Any, forward: Any, turn: Any, lateral: Any, dt: Any, like: Any):
    """Return the way (m) and the turn (rad) of the body, body frame, see `coopenv.motions.dispatch`."""
    o = type(like)()
    return type(like)(forward, o[1], o[2]), type(like)(o[0], o[1], forward * wp.tan(turn) / d.wheelbase)
