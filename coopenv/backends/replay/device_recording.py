"""A recording as arrays on a device."""

from functools import cache
from typing import Any

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from coopenv.observers.recording import Recording, Truth
from coopenv.world.precision import Precision
from coopenv.world.records import array, fields


@cache
def record_struct(p: Precision) -> Any:
    """Return the Warp struct of a recording in one precision."""
    vec3, mat33 = p.vec3, p.mat33

    @wp.struct
    class Record:
        """K ticks, N vehicles, T targets, L landmarks; lengths in m."""

        last: wp.int32  # K - 1
        rotation: array("KN", mat33)  # odometry increments
        translation: array("KN", vec3)
        velocity: array("KN", vec3)  # m/s, last odometry sample
        angular_velocity: array("KN", vec3)  # rad/s
        samples: array("KN", wp.int32)  # odometry samples so far
        bearings: array("KNT", vec3)  # body frame
        bearing_lag: array("KN", wp.int32)  # ticks since the frame was exposed
        visible: array("KNT", wp.uint8)
        landmarks: array("KL", vec3)  # map
        inbox_tick: array("KNN", wp.int32)  # of sending, per receiver and sender; BY_RADIO: not known
        true_rotation: array("KN", mat33)  # NaN: not known
        true_position: array("KN", vec3)
        true_velocity: array("KN", vec3)  # body frame, m/s
        true_angular_velocity: array("KN", vec3)  # rad/s
        start_rotation: array("N", mat33)  # initial estimates; NaN: as the scenario says
        start_position: array("N", vec3)  # map

    return Record


def upload(recording: Recording, odometry_rate: float, p: Precision, device: str) -> Any:
    """Return the `Record` of a recording."""
    linear, angular = true_twists(recording.truth, recording.dt)
    shape = recording.ticks, len(recording.setups)
    values: dict[str, np.ndarray] = {
        "samples": np.broadcast_to(samples_taken(recording.t, odometry_rate)[:, None], shape),
        "bearing_lag": np.zeros(shape),
        "true_rotation": recording.truth.rotation,
        "true_position": recording.truth.position,
        "true_velocity": linear,
        "true_angular_velocity": angular,
    }
    record = record_struct(p)()
    record.last = recording.ticks - 1
    for name, field in fields(record_struct(p)).items():
        data = values[name] if name in values else getattr(recording, name)
        kind = {wp.int32: np.int32, wp.uint8: np.uint8}.get(field.dtype, p.numpy)
        setattr(record, name, wp.array(np.array(data, dtype=kind), dtype=field.dtype, device=device))
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
