"""One step of a driven vehicle by its kind of motion: a Warp function for all rows of the table.

A kind gives one Warp function, `displacement(d, forward, turn, lateral, dt, like)`. It returns the way (m) and the turn
(rad) of the body over dt (s), both (3,) in the body frame of the middle of the step, from the ways `forward` and
`lateral` (m) and the mean `turn` of the second column. `d` holds the vehicle's `DynamicsValues`, and `like` is any
vector (3,) of the precision. Over one second it is the twist.
"""

from collections.abc import Sequence
from pkgutil import resolve_name
from typing import Any

import warp as wp

from coopenv.estimation.linalg import increment
from coopenv.motions.command import actuate
from coopenv.motions.table import DRIVES, MOTIONS


def _chosen(names: Sequence[str]) -> Any:
    """Return the Warp function that calls the `displacement` of the kind of a vehicle, one of these."""
    first = resolve_name(MOTIONS[names[0]].functions)
    if len(names) == 1:
        return first
    others, number = _chosen(names[1:]), wp.constant(DRIVES.index(names[0]))

    @wp.func
    def displacement_of(d: Any, forward: Any, turn: Any, lateral: Any, dt: Any, like: Any):
        """Return way and turn by the first kind, or by another one."""
        way, turned = others(d, forward, turn, lateral, dt, like)
        if d.kind == number:
            way, turned = first(d, forward, turn, lateral, dt, like)
        return way, turned

    return displacement_of


displacement = _chosen(DRIVES)
"""(d, forward, turn, lateral, dt, like): way and turn by the vehicle's own kind, see above."""


@wp.func
def drive_step(d: Any, R: Any, position: Any, speed: Any, turn: Any, lateral: Any, command: Any, dt: Any, parked: int):
    """Return (R, position, speed, turn, lateral speed) after dt under a command: its twist held at the mid-point.

    A parked vehicle stands at once.
    """
    new_speed, new_turn, new_lateral = actuate(d, speed, turn, lateral, command, dt)
    half = type(speed)(0.5)
    mid_speed = (speed + new_speed) * half
    mid_lateral = (lateral + new_lateral) * half
    held = dt
    if parked != 0:
        new_speed = type(speed)(0.0)
        new_lateral = type(speed)(0.0)
        mid_speed = new_speed
        mid_lateral = new_lateral
        held = type(dt)(0.0)
    way, turned = displacement(d, mid_speed * dt, (turn + new_turn) * half, mid_lateral * dt, held, position)
    new_R, new_position = increment(R, position, way, turned, type(speed)(1.0))
    return new_R, new_position, new_speed, new_turn, new_lateral
