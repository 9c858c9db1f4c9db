"""The changing side of a world: one record of arrays with leading axes (world, agent or vehicle).

W worlds, A agents (landmarks first), N vehicles, M odometry samples a tick, S slots of the
radio's outbox, B blocks of the sliding Gramian.
"""

from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np
import warp as wp

from coopenv.estimation.trajectory import Outcome, Sight
from coopenv.scenario.base import LARGEST
from coopenv.world.precision import Precision
from coopenv.world.saved_state import (
    ANYTHING,
    COVARIANCE,
    DIRECTION,
    FLAG,
    NUMBER,
    ODOMETRY_SAMPLES,
    ROTATION,
    TICK,
    Rule,
    numbers,
    whole,
)


@cache
def state_struct(p: Precision) -> Any:
    """Return the Warp struct of the state in one precision."""
    scalar, vec2, vec3, mat33, mat66 = p.scalar, p.vec2, p.vec3, p.mat33, p.mat66

    @wp.struct
    class State:
        """Everything that changes. Lengths in m, angles in rad, map and body frames as named."""

        seed: wp.array(dtype=wp.uint64)  # (W,)
        episode: wp.array(dtype=wp.uint32)  # (W,)
        tick: wp.array(dtype=wp.int32)  # (W,) camera ticks since the reset

        start_rotation: wp.array2d(dtype=mat33)  # (W, A)
        start_position: wp.array2d(dtype=vec3)  # (W, A) map
        rotation: wp.array2d(dtype=mat33)  # (W, A) truth, body to map
        position: wp.array2d(dtype=vec3)  # (W, A) truth, map
        velocity: wp.array2d(dtype=vec3)  # (W, A) truth, body, m/s
        angular_velocity: wp.array2d(dtype=vec3)  # (W, A) truth, body, rad/s
        speed: wp.array2d(dtype=scalar)  # (W, N) of the bicycle, m/s
        steering: wp.array2d(dtype=scalar)  # (W, N) rad
        command: wp.array2d(dtype=vec2)  # (W, N) action in force
        ended: wp.array2d(dtype=wp.int32)  # (W, N) values of `Outcome`
        collided: wp.array2d(dtype=wp.int32)  # (W, N) touching something now

        sampled_velocity: wp.array3d(dtype=vec3)  # (W, N, M) truth at the odometry samples of the last tick, m/s, body
        sampled_angular_velocity: wp.array3d(dtype=vec3)  # (W, N, M) likewise, rad/s; of driven vehicles

        odometry_velocity: wp.array2d(dtype=vec3)  # (W, N) last sample, m/s
        odometry_angular_velocity: wp.array2d(dtype=vec3)  # (W, N) last sample, rad/s
        odometry_samples: wp.array2d(dtype=wp.int32)  # (W, N) samples taken; sample m is at m / rate
        increment_rotation: wp.array2d(dtype=mat33)  # (W, N) odometry over the last tick
        increment_translation: wp.array2d(dtype=vec3)  # (W, N) m, in the body frame at the tick's start

        bearing: wp.array3d(dtype=vec3)  # (W, N, A) camera to target, camera frame, last measured
        bearing_tick: wp.array3d(dtype=wp.int32)  # (W, N, A) tick of that bearing; -1: never
        sight: wp.array3d(dtype=wp.uint8)  # (W, N, A) values of `Sight`

        outbox_rotation: wp.array3d(dtype=mat33)  # (W, N, S) Rhat as sent
        outbox_position: wp.array3d(dtype=vec3)  # (W, N, S) Rhat phat as sent, map
        outbox_tick: wp.array3d(dtype=wp.int32)  # (W, N, S) -1: nothing sent in this slot
        inbox_rotation: wp.array3d(dtype=mat33)  # (W, N receiver, N sender)
        inbox_position: wp.array3d(dtype=vec3)  # (W, N, N) map
        inbox_tick: wp.array3d(dtype=wp.int32)  # (W, N, N) tick of sending; -1: never heard

        estimate_rotation: wp.array2d(dtype=mat33)  # (W, N) Rhat
        estimate_position: wp.array2d(dtype=vec3)  # (W, N) phat, in the body frame
        covariance: wp.array2d(dtype=mat66)  # (W, N) P over (2 lambda, p)
        corrected_tick: wp.array2d(dtype=wp.int32)  # (W, N) tick of the observer's last correction

        gramian_11: wp.array3d(dtype=mat33)  # (W, N, B) block sums of int C^T C dt, map axes
        gramian_12: wp.array3d(dtype=mat33)  # (W, N, B)
        gramian_22: wp.array3d(dtype=mat33)  # (W, N, B)
        gramian_time: wp.array3d(dtype=scalar)  # (W, N, B) s

    return State


VALID: dict[str, Rule] = {
    "seed": ANYTHING,
    "episode": ANYTHING,
    "tick": whole(0, "horizon_ticks"),
    "start_rotation": ROTATION,
    "rotation": ROTATION._replace(of_truth=True),
    "position": NUMBER._replace(of_truth=True),
    "velocity": NUMBER._replace(of_truth=True),
    "angular_velocity": NUMBER._replace(of_truth=True),
    "steering": numbers(1.6),
    "command": numbers(1.001),
    "ended": whole(min(Outcome), max(Outcome)),
    "collided": FLAG,
    "odometry_samples": ODOMETRY_SAMPLES,
    "increment_rotation": ROTATION,
    "bearing": DIRECTION,
    "bearing_tick": TICK,
    "sight": whole(min(Sight), max(Sight)),
    "outbox_rotation": ROTATION,
    "outbox_tick": TICK,
    "inbox_rotation": ROTATION,
    "inbox_tick": TICK,
    "estimate_rotation": ROTATION,
    "covariance": COVARIANCE,
    "corrected_tick": whole(0, "tick"),
    **dict.fromkeys(("gramian_11", "gramian_12", "gramian_22"), numbers(LARGEST**3)),
    "actions": ANYTHING,
}
"""What a saved state may hold; numbers that are not in it have to be finite."""


def allocate_state(model: Any, worlds: int, p: Precision, device: str) -> Any:
    """Return a zeroed `State` for `worlds` worlds of a model."""
    N, A = model.vehicles, model.agents
    shapes = {
        "seed": (worlds,),
        "episode": (worlds,),
        "tick": (worlds,),
        **dict.fromkeys(("sampled_velocity", "sampled_angular_velocity"), (worlds, N, model.samples_per_tick)),
        **dict.fromkeys(("bearing", "bearing_tick", "sight"), (worlds, N, A)),
        **dict.fromkeys(("outbox_rotation", "outbox_position", "outbox_tick"), (worlds, N, model.radio.slots)),
        **dict.fromkeys(("inbox_rotation", "inbox_position", "inbox_tick"), (worlds, N, N)),
        **dict.fromkeys(("gramian_11", "gramian_12", "gramian_22", "gramian_time"), (worlds, N, model.observer.blocks)),
        **dict.fromkeys(
            ("start_rotation", "start_position", "rotation", "position", "velocity", "angular_velocity"),
            (worlds, A),
        ),
    }
    state = state_struct(p)()
    for name, field in state_fields(p).items():
        setattr(state, name, wp.zeros(shapes.get(name, (worlds, N)), dtype=field.dtype, device=device))
    return state


def state_fields(p: Precision) -> dict[str, Any]:
    """Return the state's fields: name to Warp array type."""
    return {name: var.type for name, var in state_struct(p).vars.items()}


def overwrite(arrays: Mapping[str, Any], values: Mapping[str, np.ndarray]) -> None:
    """Overwrite device arrays by name, with values that `checked_state` has returned."""
    for name, target in arrays.items():
        target.assign(values[name])
