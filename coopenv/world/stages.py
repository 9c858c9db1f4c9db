"""The stages of a tick as kernels of their own, for estimators that run on the host in between.

`active` (W,) marks the worlds that take part. A tick has its number from the start; `finish_kernel` counts it.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from coopenv.world.gramian import sample_gramian
from coopenv.world.step import finish, sense
from coopenv.world.v2x import broadcast, deliver


def sense_kernel(model: Any, state: Any, active: wp.array(dtype=wp.int32), actions: wp.array2d(dtype=Any)):
    """Move and measure. One thread per world."""
    world = wp.tid()
    if active[world] != 0:
        sense(model, state, actions, world, state.tick[world] + 1)


def deliver_kernel(model: Any, state: Any, active: wp.array(dtype=wp.int32), vehicle: int):
    """Receive. One thread per world."""
    world = wp.tid()
    if active[world] != 0:
        deliver(model, state, world, vehicle, state.tick[world] + 1)


def broadcast_kernel(model: Any, state: Any, active: wp.array(dtype=wp.int32), vehicle: int):
    """Take what has been written as the vehicle's estimate, and send it. One thread per world."""
    world = wp.tid()
    if active[world] != 0:
        tick = state.tick[world] + 1
        sample_gramian(model, state, world, vehicle, tick)
        broadcast(model, state, world, vehicle, tick)


def finish_kernel(model: Any, state: Any, active: wp.array(dtype=wp.int32), actions: wp.array2d(dtype=Any)):
    """End the tick. One thread per world."""
    world = wp.tid()
    if active[world] != 0:
        finish(model, state, actions, world, state.tick[world] + 1)
