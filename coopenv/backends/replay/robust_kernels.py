"""A tick of a recording with the embedded observer `robust`."""

from __future__ import annotations

from typing import Any

import warp as wp

from coopenv.backends.replay.kernels import redeliver, resense, rewind
from coopenv.observers.robust.observer import update
from coopenv.observers.robust.start import start_world
from coopenv.observers.robust.tracklets import tell
from coopenv.world.step import finish
from coopenv.world.v2x import broadcast

wp.set_module_options({"max_unroll": 1})  # long straight code would take long to compile


def replay_robust_kernel(
    model: Any,
    state: Any,
    mind: Any,
    record: Any,
    actions: wp.array2d(dtype=Any),
    hold: wp.array(dtype=wp.int32),
    ticks: int,
):
    """Advance as `replay_kernel` does. One thread per world."""
    world = wp.tid()
    count = wp.where(hold[world] == 0, wp.min(ticks, model.horizon_ticks - state.tick[world]), 0)
    for _ in range(count):
        tick = state.tick[world] + 1
        resense(model, state, record, world, tick)
        for place in range(model.vehicles):
            vehicle = model.order[place]
            redeliver(model, state, record, world, vehicle, tick)
            update(model, state, mind, world, vehicle, tick)
            broadcast(model, state, world, vehicle, tick)
            tell(model, mind, world, vehicle, tick)
        finish(model, state, actions, world, tick)


def rewind_robust_kernel(model: Any, state: Any, mind: Any, record: Any, mask: wp.array(dtype=wp.int32)):
    """Go to the start of the recording in every world whose mask is set. One thread per world."""
    world = wp.tid()
    if mask[world] != 0:
        rewind(model, state, record, world)
        start_world(model, state, mind, world)
