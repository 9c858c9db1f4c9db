"""What the one car of a room does, as kernels: one thread per world, of which there is one."""

from typing import Any

import warp as wp

from coopenv.world.camera import observe
from coopenv.world.dynamics import drive, prescribe
from coopenv.world.lasting_errors import drift


def drive_one(model: Any, state: Any, duration: wp.array(dtype=wp.float64), vehicle: int):
    """Let one vehicle follow its command for a while, s."""
    world = wp.tid()
    drive(model, state, world, vehicle, state.command[world, vehicle], duration[world])


def prescribe_one(model: Any, state: Any, time: wp.array(dtype=wp.float64), agent: int):
    """Put one agent where its prescribed motion is at a time since the start, s."""
    world = wp.tid()
    prescribe(model, state, world, agent, time[world])


def look_once(model: Any, state: Any, frame: wp.array(dtype=wp.int32), vehicle: int):
    """Carry the lasting errors of one vehicle to a camera frame and take it; frames count from the start."""
    world = wp.tid()
    drift(model, state, world, vehicle, frame[world])
    observe(model, state, world, vehicle, frame[world])
