"""Setups: what vehicles of a simulated world know before the start, of sensors, noise and the initial estimate."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from coopenv.estimation import UNIFORM_ROTATION
from coopenv.estimation.poses import Array, about_z
from coopenv.measurements.sensor import MAP, Sensor
from coopenv.observers.contract import MIN_BEARING_STD, Gains, ObserverInit, SensorNoise, Setup
from coopenv.scenario import Scenario
from coopenv.scenario.schema import neighbour_sets

EXACT_START_STD = 1e-3  # rad and m, where a scenario starts its estimates at the truth


def observer_init_of(scenario: Scenario, model: Any) -> ObserverInit:
    """Return the initial data of the observers of a simulated world."""
    s, L, places = scenario, len(scenario.landmarks), scenario.cameras
    cameras, noises = model.camera.numpy(), model.noise.numpy()
    targets, counts = model.targets.numpy(), model.target_count.numpy()
    sets = neighbour_sets(s) if s.keeps_those_in_range else [targets[i, :n] for i, n in enumerate(counts)]
    k, q = model.observer.k.numpy(), model.observer.q.numpy().astype(float)
    setups = tuple(
        Setup(
            vehicle=i,
            name=name,
            target_names=tuple(s.target_names),
            landmarks=L,
            targets=np.array(sets[i], dtype=np.int64),
            lever_arm=np.array(places[i].position, float),
            marker=np.array(s.vehicles[i].marker, float),
            noise=_noise_of(scenario, i, cameras[i], noises[i]),
            gains=Gains(float(k[i]), q, s.observer.V, s.observer.P0, s.observer.max_turn),
            optical_axis=_in_body(cameras[i], (0.0, 0.0, 1.0)),
            sensors=sensors_of(s, i, sets[i]),
            landmark_rotation=landmark_rotations(s) if s.sensors else None,
            landmark_std=s.landmark_std,
        )
        for i, name in enumerate(s.vehicle_names)
    )
    return ObserverInit(
        setups=setups,
        order=tuple(int(i) for i in model.order.numpy()),
        dt=1.0 / s.rates.camera,
        period=s.v2x.period,
        staleness=math.inf if s.v2x.staleness is None else s.v2x.staleness,
        flight=max(s.v2x.delay, 1),
        start_covariance=start_covariances(s),
    )


def sensors_of(scenario: Scenario, vehicle: int, neighbours: Sequence[int]) -> tuple[Sensor, ...]:
    """Return the sensors of a vehicle beside its camera, in the order of the scenario, towards its neighbours.

    Raises:
        CoopenvError: a kind cannot be used, or its noise has another number of rows.
    """
    sensors = []
    for section in scenario.sensors:
        if not section.is_on(scenario.vehicle_names[vehicle]):
            continue
        kind, std = section.made, section.counted(scenario.rates.camera)
        found = [j for j in neighbours if section.measures(scenario, int(j))]
        sensors.append(
            Sensor(
                name=section.label,
                reference=section.kind,
                std=std if scenario.noise.enabled else np.full(kind.rows, MIN_BEARING_STD),
                targets=np.array(found if kind.has_target else [MAP], np.int64),
                position=np.array(section.position),
                rotation=section.mounting,
                options=section.arguments,
                bias=tuple(section.by_row("bias", section.bias).tolist()) if scenario.noise.enabled else (),
            )
        )
    return tuple(sensors)


def landmark_rotations(scenario: Scenario) -> Array:
    """Return the orientations (L, 3, 3) of the landmarks on the map, NaN for those that move."""
    yaw = [mark.yaw if mark.motion.kind == "static" else np.nan for mark in scenario.landmarks]
    return about_z(np.array(yaw, float))


def _in_body(camera: Any, direction: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return the unit vector in the body frame of a direction (3,) in the camera frame."""
    along = camera["rotation"].astype(float) @ np.array(direction, float)
    x, y, z = (along / np.linalg.norm(along)).tolist()
    return x, y, z


def _noise_of(scenario: Scenario, vehicle: int, camera: Any, noise: Any) -> SensorNoise:
    """Return the noise of one vehicle from its entries of the model.

    Rounded pixels add to that of bearings, and so does a correlated error, as white noise that averages as it does.
    """
    bearing, axis = float(noise["bearing"]), None
    if noise["bearing_paper"]:
        bearing /= math.sqrt(3.0)
        axis = _in_body(camera, scenario.noises[vehicle].bearing.axis)
    if camera["quantise"]:
        bearing = math.hypot(bearing, 1.0 / (math.sqrt(12.0) * float(camera["focal_length"].min())))
    bearing = math.hypot(bearing, float(noise["bearing_counted"]))
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
        latency=float(camera["latency_std"]),
        latency_jitter=float(camera["latency_jitter"]),
        camera_orientation_walk=float(camera["orientation_walk"]),
        clock_offset=scenario.all_faults[vehicle].clock_offset,
        odometry_period=1.0 / scenario.rates.odometry,
        bearing=bearing,
        image_axis=axis,
    )


def start_covariances(scenario: Scenario) -> Array:
    """Return the covariances (N, 6, 6) of the initial estimates in LEFT coordinates.

    Where the scenario draws the initial error it is that error's. Per axis: a^2 / 9 of an angle U(0, a) about a random
    axis, (pi^2 / 3 + 2) / 3 of a rotation uniform over SO(3), r^2 / 5 of a point uniform in a ball of radius r. For a
    fixed initial error it is the scenario's P(0).
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
