"""Scenes for the observer `robust`, and what to read off worlds of them."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from coopenv.observers import Recording
from coopenv.runs.recorder import record
from coopenv.scenario import Scenario, load_scenario

ISOTROPIC = {
    "noise.bearing.model": "isotropic",
    "noise.bearing.scale": 0.005 / math.sqrt(3.0),
    "noise.bearing.rate": "sample",
    "noise.odometry_rate": "sample",
    "rates.odometry": 60.0,
}
SMALL_ERRORS = {
    "vehicles.*.initial_estimate": {
        "position": None,
        "position_radius": 1.0,
        "orientation_angle": math.radians(10.0),
        "orientation_offset_wxyz": [1.0, 0.0, 0.0, 0.0],
    }
}
"""Initial errors drawn up to 10 degrees and 1 m."""


@cache
def small_errors(horizon: float, seed: int = 0) -> Recording:
    """Isotropic noise of 2.9 mrad; initial errors up to 10 degrees and 1 m."""
    return record(load_scenario("busy_intersection", {**ISOTROPIC, **SMALL_ERRORS, "horizon": horizon}), seed)


@cache
def everybody_sees_everybody(horizon: float) -> Recording:
    """Three landmarks and all other vehicles for each: rumours go round in every way."""
    names = load_scenario("busy_intersection").target_names
    everybody = {f"vehicles.{own}.neighbours": [n for n in names if n != own] for own in names[3:]}
    overrides = {**ISOTROPIC, **SMALL_ERRORS, **everybody, "horizon": horizon, "topology.acyclic": False}
    return record(load_scenario("busy_intersection", overrides), 0)


@cache
def noise_free(horizon: float, name: str = "busy_intersection") -> Recording:
    """The paper's start without noise."""
    return record(load_scenario(name, {"noise.enabled": False, "horizon": horizon}))


@cache
def crowd(horizon: float, leaders: int, gone: int) -> Recording:
    """One vehicle that hears more leaders than it can keep; the first of them are out of its view from a third on.

    Args:
        horizon: s.
        leaders: how many.
        gone: how many go out of view.
    """
    raw = load_scenario("busy_intersection_tracking", {"horizon": horizon}).model_dump()
    template, landmarks = raw["vehicles"][0], tuple(landmark["name"] for landmark in raw["landmarks"])

    def vehicle(place: tuple[float, ...], speed: float, neighbours: tuple[str, ...]) -> dict[str, Any]:
        motion = {**template["motion"], "linear": (0.0, speed, 0.0)}
        return {**template, "initial_pose": {"position": place}, "motion": motion, "neighbours": neighbours}

    lead = [vehicle((-2.0 - 1.5 * n, -10.0 + 2.0 * n, 2.0), 0.3, landmarks) for n in range(leaders)]
    follower = vehicle((-12.0, -16.0, 2.5), 0.6, tuple(f"vehicle_{n + 1}" for n in range(leaders)))
    raw["vehicles"] = [*lead, follower]
    recording = record(Scenario(**raw), 0)
    visible = recording.visible.copy()
    first = recording.landmarks.shape[1]
    visible[recording.ticks // 3 :, leaders, first : first + gone] = False
    return replace(recording, visible=visible, bearings=np.where(visible[..., None], recording.bearings, np.nan))
