"""What the observers of a world are told before it starts: from the scenario and its model, never from truth."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from coopenv.estimation.arrays import Array
from coopenv.observers.contract import Gains, SensorNoise, Setup
from coopenv.observers.recording import Briefing
from coopenv.scenario import Scenario

EXACT_START_STD = 1e-3
"""rad and m, where a scenario starts its estimates at the truth."""


def setups_of(scenario: Scenario, model: Any) -> tuple[Setup, ...]:
    """Return what each vehicle of a world knows before it starts."""
    noise, observer = model.noise, model.observer
    bearing = float(noise.bearing) / (math.sqrt(3.0) if noise.bearing_paper else 1.0)
    sensor_noise = SensorNoise(
        float(noise.velocity),
        float(noise.angular_velocity),
        1.0 / scenario.rates.odometry,
        bearing,
        _image_axis(scenario, model) if noise.bearing_paper else None,
    )
    L = len(scenario.landmarks)
    targets, counts = model.targets.numpy(), model.target_count.numpy()
    k, q = observer.k.numpy(), observer.q.numpy().astype(float)
    return tuple(
        Setup(
            vehicle=i,
            name=name,
            target_names=tuple(scenario.target_names),
            landmarks=L,
            targets=targets[i, : counts[i]].astype(np.int64),
            lever_arm=np.array(scenario.camera.position, float),
            marker=np.array(scenario.vehicles[i].marker, float),
            noise=sensor_noise,
            gains=Gains(float(k[i]), q, scenario.observer.V, scenario.observer.P0, scenario.observer.max_turn),
        )
        for i, name in enumerate(scenario.vehicle_names)
    )


def _image_axis(scenario: Scenario, model: Any) -> tuple[float, float, float]:
    """Return the axis of the paper's noise formula, unit vector in the body frame."""
    axis = np.array(model.camera.rotation, dtype=float).reshape(3, 3) @ np.array(scenario.noise.bearing.axis, float)
    x, y, z = (axis / np.linalg.norm(axis)).tolist()
    return x, y, z


def start_covariance(scenario: Scenario, vehicle: int) -> Array:
    """Return the covariance (6, 6) of the initial estimate in LEFT coordinates.

    Where the scenario draws the initial error it is that error's. Per axis: a^2 / 9 of an angle U(0, a) about a random
    axis, (pi^2 / 3 + 2) / 3 of a rotation uniform over SO(3), r^2 / 5 of a point uniform in a ball of radius r. A fixed
    initial error is no distribution: the scenario's P(0) stands for it.
    """
    e, (angle_P0, position_P0) = scenario.vehicles[vehicle].initial_estimate, scenario.observer.P0
    floor = EXACT_START_STD**2
    uniform = (math.pi**2 / 3.0 + 2.0) / 3.0
    angle_variance = uniform if e.orientation_angle == "uniform" else float(e.orientation_angle) ** 2 / 9.0
    turned = e.yaw is not None or e.quaternion_wxyz is not None or abs(e.orientation_offset_wxyz[0]) < 1.0 - 1e-12
    moved = e.position is not None or any(e.position_offset)
    variances = (
        angle_P0 if turned else max(angle_variance, floor),
        position_P0 if moved else max(e.position_radius**2 / 5.0, floor),
    )
    return np.diag(np.repeat(variances, 3))


def start_covariances(scenario: Scenario) -> Array:
    """Return the covariances (N, 6, 6) of all initial estimates, see `start_covariance`."""
    return np.array([start_covariance(scenario, i) for i in range(len(scenario.vehicles))])


def briefing_of(scenario: Scenario, model: Any) -> Briefing:
    """Return what the observers of a simulated world are told."""
    return Briefing(
        setups=setups_of(scenario, model),
        order=tuple(int(i) for i in model.order.numpy()),
        dt=1.0 / scenario.rates.camera,
        period=scenario.v2x.period,
        staleness=math.inf if scenario.v2x.staleness is None else scenario.v2x.staleness,
        flight=max(scenario.v2x.delay, 1),
        start_covariance=start_covariances(scenario),
    )
