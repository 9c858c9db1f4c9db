"""Turn a vehicle's camera and noise into the numbers of the `Model`."""

import math
from typing import Any

import numpy as np

from coopenv.estimation.lens import largest_radius
from coopenv.scenario.sensing import Camera, Noise, Rates


def camera_entries(c: Camera, noise: Noise) -> dict[str, Any]:
    """Return the values of the model's `Camera`."""
    on = float(noise.enabled)
    same = ("position", "image_size", "focal_length", "principal_point")
    return {
        **{name: getattr(c, name) for name in same},
        "rotation": c.to_body(),
        "pinhole": int(c.model == "pinhole"),
        **dict(zip(("k1", "k2", "p1", "p2", "k3"), c.distortion, strict=True)),
        "max_radius": largest_radius(c.distortion),
        "undistort": int(c.undistort),
        "quantise": int(c.quantise),
        "range": math.inf if c.range is None else c.range,
        "miss": c.miss_probability,
        "orientation_std": on * c.extrinsics_error,
        "position_std": on * c.extrinsics_position_error,
        "focal_std": on * c.focal_length_error,
    }


def noise_entries(n: Noise, rates: Rates) -> dict[str, Any]:
    """Return the values of the model's `Noise`."""
    on = float(n.enabled)
    axis = np.array(n.bearing.axis) / np.linalg.norm(n.bearing.axis)
    first = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    if abs(axis[2]) > 1 - 1e-12:
        first = np.array([1.0, 0.0, 0.0])
    first = first / np.linalg.norm(first)
    return {
        "velocity": on * _at_rate(n.velocity, n.odometry_rate, rates.odometry),
        "angular_velocity": on * _at_rate(n.angular_velocity, n.odometry_rate, rates.odometry),
        "bearing_paper": int(n.bearing.model == "paper"),
        "bearing": on * _at_rate(n.bearing.scale, n.bearing.rate, rates.camera),
        "axis": np.column_stack([first, np.cross(axis, first), axis]),
        **_lasting(n),
    }


def _lasting(n: Noise) -> dict[str, Any]:
    """Return the errors of the odometry that last."""
    on, slip = float(n.enabled), n.slip
    return {
        "lasting": int(n.enabled and n.lasts),
        "odometry_scale": on * n.odometry_scale,
        "odometry_scale_walk": on * n.odometry_scale_walk,
        "gyro_bias": on * np.broadcast_to(n.gyro_bias, 3),
        "gyro_bias_walk": on * np.broadcast_to(n.gyro_bias_walk, 3),
        "slip_rate": on * slip.rate,
        "slip_duration": slip.duration,
        "slip_size": slip.size,
        "slip_angle": slip.angle,
    }


def _at_rate(std: float, stated: float | str, actual: float) -> float:
    """Return the standard deviation per sample that keeps the density std^2 / stated rate."""
    return std if isinstance(stated, str) else std * float(np.sqrt(actual / stated))
