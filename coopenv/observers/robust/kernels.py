"""The kernels of a world whose vehicles run this observer."""

from __future__ import annotations

from typing import Any

import warp as wp

from coopenv.observers.robust.observer import update
from coopenv.observers.robust.start import start_world
from coopenv.observers.robust.tracklets import tell
from coopenv.world.reset import reset_world
from coopenv.world.step import finish, sense
from coopenv.world.v2x import broadcast, deliver

wp.set_module_options({"max_unroll": 1})  # long straight code would take long to compile


def advance_robust_kernel(
    model: Any, state: Any, mind: Any, actions: wp.array2d(dtype=Any), hold: wp.array(dtype=wp.int32), ticks: int
):
    """Advance as `advance_kernel` does. One thread per world."""
    world = wp.tid()
    count = wp.where(hold[world] == 0, wp.min(ticks, model.horizon_ticks - state.tick[world]), 0)
    for _ in range(count):
        tick = state.tick[world] + 1
        sense(model, state, actions, world, tick)
        for place in range(model.vehicles):
            vehicle = model.order[place]
            deliver(model, state, world, vehicle, tick)
            update(model, state, mind, world, vehicle, tick)
            broadcast(model, state, world, vehicle, tick)
            tell(model, mind, world, vehicle, tick)
        finish(model, state, actions, world, tick)


def reset_robust_kernel(model: Any, state: Any, mind: Any, mask: wp.array(dtype=wp.int32)):
    """Start the next episode in every world whose mask is set. One thread per world."""
    world = wp.tid()
    if mask[world] != 0:
        state.episode[world] = state.episode[world] + wp.uint32(1)
        reset_world(model, state, world)
        start_world(model, state, mind, world)
