"""Clocks that are not quite right: a sender was where it says at another time, so that it is off along its velocity.

Where clocks are declared to be off by a standard deviation, that error is considered like the sender's own: it adds
2 s^2 v v^T to the covariance that it states, for its clock and the receiver's, and correlates with all that follows.
"""

from typing import Any

import warp as wp

from coopenv.estimation.linalg import symmetric_part
from coopenv.observers.robust.constants import LEAST_CHANGE, SHARE_OF_CHANGE
from coopenv.observers.robust.memory import mat66d
from coopenv.world.device_function import device_function


@device_function
def by_clocks(model: Any, memory: Any, world: int, i: int, n: int):
    """Return the covariance, 6x6, of how far member n is off by clocks; zero before its velocity is known."""
    std = wp.float64(model.fault[i].clock)
    v = memory.member[world, i, n].dated_v
    P = mat66d()
    P[3:, 3:] = (wp.float64(2.0) * std * std) * wp.outer(v, v)
    return P


@device_function
def changes_speed(model: Any, memory: Any, world: int, i: int, n: int) -> bool:
    """Let clocks count by the velocity of member n where that has changed much; return whether it has.

    A covariance that followed every change would not be one.
    """
    if model.fault[i].clock == type(model.fault[i].clock)(0.0):
        return False
    v = memory.member[world, i, n].v
    dated = memory.member[world, i, n].dated_v
    if wp.length(v - dated) <= wp.float64(SHARE_OF_CHANGE) * wp.length(dated) + wp.float64(LEAST_CHANGE):
        return False
    memory.member[world, i, n].dated_v = v
    P = memory.P[world, i, n, n] + by_clocks(model, memory, world, i, n)
    memory.P[world, i, n, n] = symmetric_part(P)
    return True
