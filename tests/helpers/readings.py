"""Recordings with readings of sensors that are sampled in NumPy from the truth, whatever hides a target."""

from dataclasses import replace
from typing import Any

import numpy as np

from coopenv.estimation.poses import Array
from coopenv.measurements.kinds import Placed
from coopenv.measurements.sensor import MAP, Sensor
from coopenv.observers.frame import ENTRY, Frame, table_of_sensors
from coopenv.observers.recording import Recording
from coopenv.observers.setups import landmark_rotations, sensors_of
from coopenv.runs.recorder import record
from coopenv.scenario import load_scenario


def twists(recording: Recording, i: int) -> tuple[Any, Any]:
    """Return velocities (K, 3) of a vehicle's origin in map axes, m/s, and rates (K, 3) in body axes, as measured."""
    R = recording.truth.rotation[:, i]
    return (R @ recording.velocity[:, i][..., None])[..., 0], recording.angular_velocity[:, i]


def place_of(recording: Recording, target: int, rotations: Any) -> Placed:
    """Return a target at all ticks."""
    L, K = recording.landmarks.shape[1], recording.ticks
    if target == MAP:
        return Placed.at(np.zeros((K, 3)))
    if target < L:
        return Placed.at(recording.landmarks[:, target], np.broadcast_to(rotations[target], (K, 3, 3)))
    j, marker = target - L, recording.setups[target - L].marker
    R, (velocity, rate) = recording.truth.rotation[:, j], twists(recording, j)
    return Placed(recording.truth.position[:, j] + R @ marker, R, velocity, rate)


def sensor_at(recording: Recording, i: int, sensor: Sensor) -> Placed:
    """Return a sensor at all ticks, by the truth."""
    R, p = recording.truth.rotation[:, i], recording.truth.position[:, i]
    return sensor.placed(R, p, recording.velocity[:, i], recording.angular_velocity[:, i])


def with_readings(recording: Recording, sensors: list[dict[str, Any]], seed: int = 0, blind: bool = False) -> Recording:
    """Return a recording with sensors of a scenario's section `sensors`; `blind`: without the camera's bearings."""
    assert recording.scenario is not None
    scenario = load_scenario(recording.scenario, {"sensors": sensors})
    rng, rotations = np.random.default_rng(seed), landmark_rotations(scenario)
    setups = tuple(
        replace(setup, sensors=sensors_of(scenario, i, setup.targets.tolist()), landmark_rotation=rotations)
        for i, setup in enumerate(recording.setups)
    )
    readings: dict[str, Any] = {}
    K, N, T = recording.visible.shape
    for i, setup in enumerate(setups):
        for sensor in setup.sensors:
            kind = sensor.kind
            columns = T if kind.has_target else 1
            values = readings.setdefault(sensor.name, np.full((K, N, columns, kind.size), np.nan))
            for target in sensor.targets.tolist():
                predicted = kind.predict(sensor_at(recording, i, sensor), place_of(recording, target, rotations))
                noise = rng.normal(size=(K, kind.rows)) * sensor.std
                values[:, i, max(target, 0)] = kind.sample(predicted, noise)
    changes: dict[str, Any] = {"setups": setups, "readings": readings, "scenario": scenario}
    if blind:
        changes |= {"visible": np.zeros_like(recording.visible), "bearings": np.full_like(recording.bearings, np.nan)}
    return replace(recording, **changes)


def recorded(name: str, sensors: list[dict[str, Any]], seed: int = 0, blind: bool = False, **keys: Any) -> Recording:
    """Return the recording of an environment with such sensors."""
    return with_readings(record(load_scenario(name, keys), seed), sensors, seed, blind)


def frame_of_bearings(
    lever_arm: Array, bearings: Array, points: Array, variance: float, covariances: Array | None = None
) -> Frame:
    """Return the arguments of compiled functions for bearings (m, 3) of a camera to points (m, 3)."""
    entries = np.zeros(len(points), ENTRY)
    entries["target"], entries["value"][:, :3], entries["position"] = np.arange(len(points)), bearings, points
    if covariances is not None:
        entries["covariance"][:, 3:, 3:] = covariances
    sensors, _ = table_of_sensors(np.asarray(lever_arm, float).tobytes(), float(np.sqrt(variance)))
    return entries, sensors, 1.0, 0
