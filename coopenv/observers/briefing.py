"""What the observers of a world are told before it starts: from the scenario and its model, never from truth."""

import math
from typing import Any

import numpy as np

from coopenv.estimation.arrays import Array
from coopenv.observers.contract import Gains, SensorNoise, Setup
from coopenv.observers.recording import Briefing
from coopenv.scenario import Scenario
from coopenv.world.fault_kinds import UNIFORM_ROTATION

EXACT_START_STD = 1e-3  # rad and m, where a scenario starts its estimates at the truth


def briefing_of(scenario: Scenario, model: Any) -> Briefing:
    """Return what the observers of a simulated world are told."""
    s, L, places = scenario, len(scenario.landmarks), scenario.cameras
    cameras, noises = model.camera.numpy(), model.noise.numpy()
    targets, counts = model.targets.numpy(), model.target_count.numpy()
    k, q = model.observer.k.numpy(), model.observer.q.numpy().astype(float)
    setups = tuple(
        Setup(
            vehicle=i,
            name=name,
            target_names=tuple(s.target_names),
            landmarks=L,
            targets=targets[i, : counts[i]].astype(np.int64),
            lever_arm=np.array(places[i].position, float),
            marker=np.array(s.vehicles[i].marker, float),
            noise=_noise_of(scenario, i, cameras[i], noises[i]),
            gains=Gains(float(k[i]), q, s.observer.V, s.observer.P0, s.observer.max_turn),
        )
        for i, name in enumerate(s.vehicle_names)
    )
    return Briefing(
        setups=setups,
        order=tuple(int(i) for i in model.order.numpy()),
        dt=1.0 / s.rates.camera,
        period=s.v2x.period,
        staleness=math.inf if s.v2x.staleness is None else s.v2x.staleness,
        flight=max(s.v2x.delay, 1),
        start_covariance=start_covariances(s),
    )


def _noise_of(scenario: Scenario, vehicle: int, camera: Any, noise: Any) -> SensorNoise:
    """Return the noise of one vehicle from its entries of the model."""
    bearing, axis = float(noise["bearing"]), None
    if noise["bearing_paper"]:
        bearing /= math.sqrt(3.0)
        along = camera["rotation"].astype(float) @ np.array(scenario.noises[vehicle].bearing.axis, float)
        x, y, z = (along / np.linalg.norm(along)).tolist()
        axis = x, y, z
    rate, duration, size, angle = (float(noise[f"slip_{name}"]) for name in ("rate", "duration", "size", "angle"))
    return SensorNoise(
        velocity=float(noise["velocity"]),
        angular_velocity=float(noise["angular_velocity"]),
        odometry_scale=float(noise["odometry_scale"]),
        odometry_scale_walk=float(noise["odometry_scale_walk"]),
        gyro_bias=tuple(noise["gyro_bias"].tolist()),
        gyro_bias_walk=tuple(noise["gyro_bias_walk"].tolist()),
        slip=(rate, duration, size, angle),
        camera_orientation=float(camera["orientation_std"]),
        camera_position=float(camera["position_std"]),
        focal_length=float(camera["focal_std"]),
        clock_offset=scenario.all_faults[vehicle].clock_offset,
        odometry_period=1.0 / scenario.rates.odometry,
        bearing=bearing,
        image_axis=axis,
    )


def start_covariances(scenario: Scenario) -> Array:
    """Return the covariances (N, 6, 6) of the initial estimates in LEFT coordinates.

    Where the scenario draws the initial error it is that error's. Per axis: a^2 / 9 of an angle U(0, a) about a random
    axis, (pi^2 / 3 + 2) / 3 of a rotation uniform over SO(3), r^2 / 5 of a point uniform in a ball of radius r. A fixed
    initial error is no distribution: the scenario's P(0) stands for it.
    """
    floor, (angle_P0, position_P0) = EXACT_START_STD**2, scenario.observer.P0
    covariances = []
    for e in (vehicle.initial_estimate for vehicle in scenario.vehicles):
        angle = UNIFORM_ROTATION if e.orientation_angle == "uniform" else float(e.orientation_angle) ** 2 / 9.0
        turned = e.yaw is not None or e.quaternion_wxyz is not None or abs(e.orientation_offset_wxyz[0]) < 1.0 - 1e-12
        moved = e.position is not None or any(e.position_offset)
        variances = (
            angle_P0 if turned else max(angle, floor),
            position_P0 if moved else max(e.position_radius**2 / 5.0, floor),
        )
        covariances.append(np.diag(np.repeat(variances, 3)))
    return np.array(covariances)
