"""The time of a tick, and what happens at a rate of its own."""

from typing import Any

import warp as wp


@wp.struct
class Now:
    """The tick that is under way."""

    tick: wp.int32  # time since the start in units of `model.camera_period`: its number, where ticks come regularly
    period: wp.float64  # s since the last tick
    due: wp.bool  # whether the scenario's observer rate asks for a correction


@wp.func
def correction_due(model: Any, tick: int) -> bool:
    """Return whether the scenario's observer rate (`rates.observer`) asks for a correction at a camera tick."""
    ratio = model.observer.rate * model.camera_period
    before = wp.floor(wp.float64(tick - 1) * ratio + wp.float64(1.0e-9))
    return wp.floor(wp.float64(tick) * ratio + wp.float64(1.0e-9)) > before


@wp.func
def regular_tick(model: Any, tick: int):
    """Return a tick of a world whose ticks come at the camera's rate."""
    now = Now()
    now.tick = tick
    now.period = model.camera_period
    now.due = correction_due(model, tick)
    return now
