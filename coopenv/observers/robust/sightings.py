"""What a vehicle that searches sees: targets whose place is known or told, and triples of them."""

from __future__ import annotations

from typing import Any

import warp as wp

from coopenv.observers.robust.measurements import NOTHING, aim
from coopenv.observers.robust.reference.observer import SPEED
from coopenv.observers.robust.reference.search import SLOW
from coopenv.observers.robust.types import wide_vector
from coopenv.world.camera import VISIBLE, marker_position
from coopenv.world.v2x import fresh

SENDER_SPEED, SLOWLY_VARYING = wp.constant(SPEED), wp.constant(SLOW)
THIRD = wp.constant(1.0 / 3.0)


@wp.func
def told_variance(model: Any, mind: Any, world: int, i: int, sender: int, tick: int):
    """Return the variance per axis, m^2, of where a sender says that it is, as it counts in the search."""
    P = mind.inbox_covariance[world, i, sender]
    variance = (wp.float64(P[3, 3]) + wp.float64(P[4, 4]) + wp.float64(P[5, 5])) * wp.float64(THIRD)
    age = wp.float64(tick - mind.inbox_tick[world, i, sender]) * model.camera_period
    gone = wp.float64(SENDER_SPEED) * age
    return wp.float64(SLOWLY_VARYING) * (variance + gone * gone)


@wp.func
def aim_at_sightings(model: Any, state: Any, mind: Any, world: int, i: int, tick: int) -> int:
    """Say what each bearing of the frame is about, and return how many targets are in view and known or told."""
    seen = int(0)
    for n in range(model.target_count[i]):
        target = model.targets[i, n]
        mind.line_place[world, n] = NOTHING
        if state.sight[world, i, target] == VISIBLE:
            b = wide_vector(model.camera.rotation * state.bearing[world, i, target])
            sender = target - model.landmarks
            if sender < 0:
                z = wide_vector(marker_position(model, state, world, target))
                aim(mind, world, n, 0, b, z, wp.float64(0.0))
                seen += 1
            elif fresh(model, state, world, i, sender, tick) and mind.inbox_says[world, i, sender] == 1:
                variance = told_variance(model, mind, world, i, sender, tick)
                aim(mind, world, n, 0, b, mind.inbox_position[world, i, sender], variance)
                seen += 1
    return seen


@wp.func
def spread(mind: Any, world: int, n0: int, n1: int, n2: int):
    """Return twice the area that three bearings span; a good triple looks in three very different directions."""
    a = mind.line_bearing[world, n0]
    return wp.length(wp.cross(mind.line_bearing[world, n1] - a, mind.line_bearing[world, n2] - a))


@wp.func
def next_triple(mind: Any, world: int, count: int, size: Any, number: int):
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
                    mind.line_place[world, n0] != NOTHING
                    and mind.line_place[world, n1] != NOTHING
                    and mind.line_place[world, n2] != NOTHING
                ):
                    area = spread(mind, world, n0, n1, n2)
                    later = area < size or (area == size and here > number)
                    if later and area > best_size:
                        best0 = n0
                        best1 = n1
                        best2 = n2
                        best_size = area
                        best_number = here
                    here += 1
    return best0, best1, best2, best_size, best_number
