"""Records of the busy intersection for tests of the robust observer."""

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


@cache
def crowd(horizon: float, leaders: int, gone: int) -> Recording:
    """One vehicle that hears more leaders than it can keep; the first of them are out of its view from a third on.

    Args:
        horizon: s.
        leaders: how many.
        gone: how many go out of view.
    """
    scenario = load_scenario("busy_intersection_tracking", {"horizon": horizon})
    template, names = scenario.vehicles[0], [f"vehicle_{n + 1}" for n in range(leaders)]
    landmarks = tuple(landmark.name for landmark in scenario.landmarks)
    lead = dict.fromkeys(names, landmarks)
    places = [(-2.0 - 1.5 * n, -10.0 + 2.0 * n, 2.0) for n in range(leaders)] + [(-12.0, -16.0, 2.5)]
    vehicles = tuple(
        template.model_copy(
            update={
                "neighbours": neighbours,
                "initial_pose": template.initial_pose.model_copy(update={"position": place}),
                "motion": template.motion.model_copy(
                    update={"linear": (0.0, 0.6 if place is places[-1] else 0.3, 0.0)}
                ),
            }
        )
        for neighbours, place in zip([*lead.values(), tuple(names)], places, strict=True)
    )
    recording = record(scenario.model_copy(update={"vehicles": vehicles}), 0)
    visible = recording.visible.copy()
    first = recording.landmarks.shape[1]
    visible[recording.ticks // 3 :, leaders, first : first + gone] = False
    return replace(recording, visible=visible, bearings=np.where(visible[..., None], recording.bearings, np.nan))
