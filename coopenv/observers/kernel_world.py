"""The world of one vehicle on the host: what it knows before it starts, and views of what changes."""

import math
from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from coopenv.observers.contract import Setup
from coopenv.world.model import entry_struct, mat66d, model_struct
from coopenv.world.precision import Precision
from coopenv.world.records import repeated


def views_of(record: Any, declared: Mapping[str, Any], vehicle: int = 0) -> SimpleNamespace:
    """Return a vehicle's part of a record's arrays, which it shares; of the first world."""
    arrays = {name: getattr(record, name).numpy() for name in declared}
    rows = {name: (0, vehicle, ...) if declared[name].axes[1:2] == "N" else (0, ...) for name in arrays}
    return SimpleNamespace(**{name: array[rows[name]] for name, array in arrays.items()})


def model_of(setup: Setup, p: Precision) -> Any:
    """Return the model of the world that a vehicle knows of."""
    L, T = setup.landmarks, len(setup.target_names)
    N, model = T - L, model_struct(p)()
    model.landmarks, model.vehicles, model.agents = L, N, T
    model.samples_per_tick = model.observer.blocks = model.ticks_per_decision = 1
    model.action_size = 2
    model.horizon_ticks = 2**31 - 1
    model.odometry_period, model.odometry_rate = setup.noise.odometry_period, 1.0 / setup.noise.odometry_period
    targets = np.full((1, T), -1, dtype=np.int32)
    targets[0, : len(setup.targets)] = setup.targets
    model.targets = repeated(wp.array(targets, dtype=wp.int32, device="cpu"), 0, N)
    model.target_count = wp.full(N, len(setup.targets), dtype=wp.int32, device="cpu")
    model.order = model.rank = wp.array(np.arange(N, dtype=np.int32), dtype=wp.int32, device="cpu")
    model.start.covariance = wp.zeros(2 * N, dtype=mat66d, device="cpu")
    camera, noise, known = entry_struct(p, "camera")(), entry_struct(p, "noise")(), setup.noise
    camera.rotation, camera.position = p.mat33(*np.eye(3).ravel()), p.vec3(*setup.lever_arm)
    for name in ("velocity", "angular_velocity", "bearing", "odometry_scale", "odometry_scale_walk"):
        setattr(noise, name, getattr(known, name))
    noise.gyro_bias, noise.gyro_bias_walk = p.vec3(*known.gyro_bias), p.vec3(*known.gyro_bias_walk)
    noise.slip_rate, noise.slip_duration, noise.slip_size, noise.slip_angle = known.slip
    camera.orientation_std, camera.position_std = known.camera_orientation, known.camera_position
    camera.focal_std = known.focal_length
    fault = entry_struct(p, "fault")()
    fault.clock = known.clock_offset
    model.fault = _for_everybody(fault, N)
    model.camera, model.noise = _for_everybody(camera, N), _for_everybody(noise, N)
    markers = np.zeros((T, 3))
    markers[L + setup.vehicle] = setup.marker
    model.scene.marker = wp.array(markers, dtype=p.vec3, device="cpu")
    model.radio.period = model.radio.slots = 1
    model.radio.range = model.radio.staleness = math.inf
    gains = setup.gains
    model.observer.k = wp.full(N, gains.k, dtype=p.scalar, device="cpu")
    model.observer.q = wp.array(gains.q, dtype=p.scalar, device="cpu")
    model.observer.v1, model.observer.v2 = gains.V
    model.observer.p1, model.observer.p2 = gains.P0
    model.observer.max_turn = gains.max_turn
    return model


def _for_everybody(entry: Any, count: int) -> Any:
    """Return the array in which every vehicle has the same entry."""
    return repeated(wp.array([entry], dtype=entry._cls, device="cpu"), 0, count)
