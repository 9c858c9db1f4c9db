"""What happens at a rate of its own."""

from __future__ import annotations

from typing import Any

import warp as wp


@wp.func
def correction_due(model: Any, tick: int) -> bool:
    """Return whether the scenario's observer rate (`rates.observer`) asks for a correction at a camera tick."""
    ratio = model.observer.rate * model.camera_period
    before = wp.floor(wp.float64(tick - 1) * ratio + wp.float64(1.0e-9))
    return wp.floor(wp.float64(tick) * ratio + wp.float64(1.0e-9)) > before
