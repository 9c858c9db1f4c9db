"""The camera's mounting, where a scenario declares that it is not quite known: how it is turned, and where it is.

Member 2 of the belief stands for it: its pose is the turn of what the camera says in the body, and the shift of its
place, with left errors as any pose has them. Bearings correct it along with all others. In a search it counts as noise.
Who hears the vehicle need not know of it.
"""

from typing import Any

import warp as wp

from coopenv.observers.robust import constants
from coopenv.observers.robust.algebra import with_noise
from coopenv.observers.robust.memory import MOUNTING, Member, vec2d
from coopenv.world.device_function import device_function


@device_function
def mounting_variances(model: Any, i: int):
    """Return the variances, as declared, of the turn and of the shift, per axis."""
    turn = wp.float64(model.camera[i].orientation_std)
    shift = wp.float64(model.camera[i].position_std)
    return vec2d(turn * turn, shift * shift)


@device_function
def has_mounting_errors(model: Any, i: int) -> bool:
    """Return whether the mounting is declared not to be known."""
    return wp.max(mounting_variances(model, i)) > wp.float64(0.0)


@device_function
def begin_mounting(model: Any, memory: Any, world: int, i: int):
    """Let member 2 stand for the mounting, and believe of it what is declared."""
    if has_mounting_errors(model, i):
        memory.belief[world, i].others = MOUNTING + 1
        mounting = Member()
        mounting.vehicle = i
        mounting.pose.R = wp.identity(3, wp.float64)
        memory.member[world, i, MOUNTING] = mounting
        declared = mounting_variances(model, i)
        least = wp.float64(constants.MIN_MOUNTING_STD * constants.MIN_MOUNTING_STD)
        P = wp.identity(6, wp.float64)
        for k in range(3):
            P[k, k] = wp.max(declared[0], least)
            P[k + 3, k + 3] = wp.max(declared[1], least)
        memory.P[world, i, MOUNTING, MOUNTING] = P


@device_function
def walk_mounting(model: Any, memory: Any, world: int, i: int, dt: Any):
    """Let the mounting be a little less certain after a time: see `MOUNTING_WALK`."""
    if mounting_of(memory, world, i) > 0:
        declared = (wp.float64(constants.MOUNTING_WALK * constants.MOUNTING_WALK) * dt) * mounting_variances(model, i)
        P = memory.P[world, i, MOUNTING, MOUNTING]
        memory.P[world, i, MOUNTING, MOUNTING] = with_noise(P, declared)


@device_function
def mounting_of(memory: Any, world: int, i: int) -> int:
    """Return the member that stands for the mounting, 0 if there is none."""
    return wp.where(memory.belief[world, i].others > MOUNTING, MOUNTING, 0)
