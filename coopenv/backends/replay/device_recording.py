"""A recording as arrays on a device."""

from functools import cache
from typing import Any

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from coopenv.observers.recording import Recording, Truth
from coopenv.world.precision import Precision


@cache
def record_struct(p: Precision) -> Any:
    """Return the Warp struct of a recording in one precision."""
    vec3, mat33 = p.vec3, p.mat33

    @wp.struct
    class Record:
        """K ticks, N vehicles, T targets, L landmarks; lengths in m."""

        rotation: wp.array2d(dtype=mat33)  # (K, N) odometry increments
        translation: wp.array2d(dtype=vec3)  # (K, N)
        velocity: wp.array2d(dtype=vec3)  # (K, N) m/s, last odometry sample
        angular_velocity: wp.array2d(dtype=vec3)  # (K, N) rad/s
        samples: wp.array(dtype=wp.int32)  # (K,) odometry samples so far
        bearings: wp.array3d(dtype=vec3)  # (K, N, T) body frame
        visible: wp.array3d(dtype=wp.uint8)  # (K, N, T)
        landmarks: wp.array2d(dtype=vec3)  # (K, L) map
        inbox_tick: wp.array3d(dtype=wp.int32)  # (K, N, N)
        true_rotation: wp.array2d(dtype=mat33)  # (K, N) NaN: not known
        true_position: wp.array2d(dtype=vec3)  # (K, N)
        true_velocity: wp.array2d(dtype=vec3)  # (K, N) body frame, m/s
        true_angular_velocity: wp.array2d(dtype=vec3)  # (K, N) rad/s
        start_rotation: wp.array(dtype=mat33)  # (N,) initial estimates
        start_position: wp.array(dtype=vec3)  # (N,) map

    return Record


def upload(recording: Recording, odometry_rate: float, p: Precision, device: str) -> Any:
    """Return the `Record` of a recording."""
    linear, angular = true_twists(recording.truth, recording.dt)
    values: dict[str, np.ndarray] = {
        "samples": samples_taken(recording.t, odometry_rate),
        "true_rotation": recording.truth.rotation,
        "true_position": recording.truth.position,
        "true_velocity": linear,
        "true_angular_velocity": angular,
    }
    record = record_struct(p)()
    for name, var in record_struct(p).vars.items():
        data = values[name] if name in values else getattr(recording, name)
        kind = {wp.int32: np.int32, wp.uint8: np.uint8}.get(var.type.dtype, p.numpy)
        setattr(record, name, wp.array(np.array(data, dtype=kind), dtype=var.type.dtype, device=device))
    return record


def samples_taken(t: np.ndarray, rate: float) -> np.ndarray:
    """Return (K,) how many odometry samples, at 0, 1 / rate, ..., a vehicle has at each tick; none at the start."""
    taken = np.floor((t + 1e-9) * rate).astype(np.int32) + 1
    taken[0] = 0
    return taken


def true_twists(truth: Truth, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean velocities (K, N, 3) over the last tick, body frame, m/s and rad/s; NaN where truth is."""
    R, position = truth.rotation, truth.position
    linear, angular = np.zeros_like(position), np.zeros_like(position)
    backwards = np.swapaxes(R[:-1], -1, -2)
    linear[1:] = (backwards @ np.diff(position, axis=0)[..., None])[..., 0] / dt
    turn = backwards @ R[1:]
    known = np.isfinite(turn).all(axis=(-1, -2))
    angular[1:] = np.nan
    if known.any():
        angular[1:][known] = Rotation.from_matrix(turn[known]).as_rotvec() / dt
    return linear, angular
