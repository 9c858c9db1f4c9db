"""Prescribed motion: a body twist that is held over a segment of time, in closed form; commands do not move it.

Odometry measures that twist.
"""

from typing import Any

import warp as wp

from coopenv.estimation.linalg import rigid_motion


@wp.func
def displacement(R: Any, linear: Any, angular: Any, h: Any):
    """Return the rotation after a body twist was held for h (s), from R, and the way (m) in the frame of R."""
    way = linear * h
    turned = R
    if wp.dot(angular, angular) > linear.dtype(0.0):
        turn, way = rigid_motion(angular * h, way)
        turned = R * turn
    return turned, way
