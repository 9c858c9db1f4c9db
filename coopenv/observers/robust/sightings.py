"""What a vehicle that searches sees: targets whose position is known or received, and triples of them."""

from __future__ import annotations

from typing import Any

import warp as wp

from coopenv.observers.robust.constants import CORRELATION_FACTOR, MAX_SPEED
from coopenv.observers.robust.measurements import NOTHING, set_line
from coopenv.observers.robust.types import wide_vector
from coopenv.world.camera import VISIBLE, marker_position
from coopenv.world.v2x import fresh

THIRD = 1.0 / 3.0


@wp.func
def received_variance(model: Any, memory: Any, world: int, i: int, sender: int, tick: int):
    """Return the variance per axis, m^2, of where a sender says that it is, as it counts in the search."""
    P = memory.inbox[world, i, sender].P
    variance = (wp.float64(P[3, 3]) + wp.float64(P[4, 4]) + wp.float64(P[5, 5])) * wp.float64(THIRD)
    age = wp.float64(tick - memory.inbox[world, i, sender].tick) * model.camera_period
    gone = wp.float64(MAX_SPEED) * age
    return wp.float64(CORRELATION_FACTOR) * (variance + gone * gone)


@wp.func
def set_lines_to_known(model: Any, state: Any, memory: Any, world: int, i: int, tick: int) -> int:
    """Set the line of sight of each bearing to a landmark or a received position; return how many there are."""
    seen = int(0)
    for n in range(model.target_count[i]):
        target = model.targets[i, n]
        memory.line[world, n].member = NOTHING
        if state.sight[world, i, target] == VISIBLE:
            b = wide_vector(model.camera.rotation * state.bearing[world, i, target])
            sender = target - model.landmarks
            if sender < 0:
                z = wide_vector(marker_position(model, state, world, target))
                set_line(memory, world, n, 0, b, z, wp.float64(0.0))
                seen += 1
            elif fresh(model, state, world, i, sender, tick) and memory.inbox[world, i, sender].valid == 1:
                variance = received_variance(model, memory, world, i, sender, tick)
                set_line(memory, world, n, 0, b, memory.inbox[world, i, sender].p, variance)
                seen += 1
    return seen


@wp.func
def spanned_area(memory: Any, world: int, n0: int, n1: int, n2: int):
    """Return twice the area that three bearings span; a good triple looks in three very different directions."""
    a = memory.line[world, n0].bearing
    return wp.length(wp.cross(memory.line[world, n1].bearing - a, memory.line[world, n2].bearing - a))


@wp.func
def next_triple(memory: Any, world: int, count: int, size: Any, number: int):
    """Return (n0, n1, n2, size, number) of the triple that spans most after the one of this size and number."""
    best0 = int(-1)
    best1 = int(-1)
    best2 = int(-1)
    best_size = wp.float64(-1.0)
    best_number = int(0)
    here = int(0)
    for n0 in range(count):
        for n1 in range(n0 + 1, count):
            for n2 in range(n1 + 1, count):
                if (
                    memory.line[world, n0].member != NOTHING
                    and memory.line[world, n1].member != NOTHING
                    and memory.line[world, n2].member != NOTHING
                ):
                    area = spanned_area(memory, world, n0, n1, n2)
                    later = area < size or (area == size and here > number)
                    if later and area > best_size:
                        best0 = n0
                        best1 = n1
                        best2 = n2
                        best_size = area
                        best_number = here
                    here += 1
    return best0, best1, best2, best_size, best_number
