"""The observer as the world is handed it."""

from __future__ import annotations

from typing import Any

import warp as wp

from coopenv.estimation.coordinates import Coordinates
from coopenv.observers.robust.messages import MESSAGES
from coopenv.observers.robust.observer import update
from coopenv.observers.robust.start import start
from coopenv.observers.robust.state import SIZES, VALID, RobustState
from coopenv.observers.robust.tracklets import tell
from coopenv.world.embedded import Embedded


@wp.func
def send(model: Any, state: Any, memory: Any, world: int, vehicle: int, tick: int):
    """Put on the air what the pose estimate leaves out: covariance and odometry."""
    tell(model, memory, world, vehicle, tick)


# Without max_unroll = 1 there is long straight code, which takes long to compile.
ROBUST = Embedded(
    "robust",
    update,
    start,
    send,
    RobustState,
    SIZES,
    valid=VALID,
    messages=MESSAGES,
    coordinates=Coordinates.LEFT,
    options={"max_unroll": 1},
)
