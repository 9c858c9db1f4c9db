"""Records of the busy intersection for tests of the robust observer."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from coopenv.estimation.observers import Recording, Tick, record
from coopenv.estimation.observers.recording import Truth
from coopenv.scenario import Scenario, load_scenario

ISOTROPIC = {
    "noise.bearing.model": "isotropic",
    "noise.bearing.scale": 0.005 / math.sqrt(3.0),
    "noise.bearing.rate": "sample",
    "noise.odometry_rate": "sample",
    "rates.odometry": 60.0,
}


@cache
def small_errors(horizon: float, seed: int = 0) -> Recording:
    """Isotropic noise of 2.9 mrad; initial errors up to 10 degrees and 1 m."""
    scenario = load_scenario("busy_intersection", {**ISOTROPIC, "horizon": horizon})
    return record(with_small_errors(scenario), seed)


def with_small_errors(scenario: Scenario) -> Scenario:
    """Return the scenario with initial errors drawn up to 10 degrees and 1 m."""
    start: dict[str, Any] = {"position": None, "position_radius": 1.0, "orientation_angle": math.radians(10.0)}
    start["orientation_offset_wxyz"] = (1.0, 0.0, 0.0, 0.0)
    vehicles = tuple(
        v.model_copy(update={"initial_estimate": v.initial_estimate.model_copy(update=start)})
        for v in scenario.vehicles
    )
    return scenario.model_copy(update={"vehicles": vehicles})


@cache
def everybody_sees_everybody(horizon: float) -> Recording:
    """Three landmarks and all other vehicles for each: rumours go round in every way."""
    scenario = load_scenario("busy_intersection", {**ISOTROPIC, "horizon": horizon, "topology.acyclic": False})
    names = scenario.vehicle_names
    landmarks = tuple(landmark.name for landmark in scenario.landmarks)
    vehicles = tuple(
        v.model_copy(update={"neighbours": landmarks + tuple(n for n in names if n != own)})
        for own, v in zip(names, scenario.vehicles, strict=True)
    )
    return record(with_small_errors(scenario.model_copy(update={"vehicles": vehicles})), 0)


@cache
def noise_free(horizon: float, name: str = "busy_intersection") -> Recording:
    """The paper's start without noise."""
    return record(load_scenario(name, {"noise.enabled": False, "horizon": horizon}))


def shifted(recording: Recording, by: np.ndarray) -> Recording:
    """The same record on a map whose origin is elsewhere."""
    return replace(
        recording,
        landmarks=recording.landmarks + by,
        start_position=recording.start_position + by,
        truth=Truth(recording.truth.rotation, recording.truth.position + by),
    )


def first_tick(recording: Recording, vehicle: int = 0, k: int = 1) -> Tick:
    """What a vehicle senses at a tick, without messages."""
    return recording.tick(k, vehicle, {})
