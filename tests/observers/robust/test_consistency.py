"""`robust` is as sure as it may be, in worlds that nothing was tuned on: ANEES with bounds of confidence, by scene.

The mean over worlds of a vehicle's NEES / 6 is compared with one, by its standard error over worlds. No covariance
is smaller than the Cramer-Rao bound has it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.linalg import eigvalsh

from coopenv.observers import run
from coopenv.observers.bound import cramer_rao_ancestors
from coopenv.runs.recorder import record
from coopenv.scenario import load_scenario
from tests.helpers.robust_scenes import with_small_errors
from tests.helpers.robust_worlds import watched

SEEDS = range(5200, 5232)
SCENES: dict[str, tuple[str, dict[str, Any]]] = {
    "tracking": ("busy_intersection_tracking", {}),
    "a lane": ("lane:5", {}),
    "a lane in which each sees three": ("lane:6,seen=3", {}),
    "a drawn graph": ("random:7,seed=521", {}),
    "a tree": ("tree:7", {}),
    "messages that are late, stale and lost": ("lane:4", {"v2x.delay": 3, "v2x.loss": 0.4, "v2x.period": 2}),
    "slow corrections": ("lane:4", {"rates.observer": 25.0, "rates.odometry": 37.0}),
    "a scale error and a bias": ("lane:4", {"noise.odometry_scale": 0.03, "noise.gyro_bias": [0.0, 0.0, 0.0087]}),
    "errors that walk": ("lane:4", {"noise.odometry_scale_walk": 0.003, "noise.gyro_bias_walk": 0.001}),
    "clocks that are off": ("lane:4", {"faults.clock_offset": 0.05}),
    "a turned camera": (
        "busy_intersection_tracking",
        {"camera.extrinsics_error": 0.02, "camera.extrinsics_position_error": 0.02},
    ),
}
EXPECTED = {"a turned camera": (0.7, 1.2)}
"""Least and most of ANEES / 6 where the errors that are estimated with the pose are not small."""


@pytest.mark.parametrize("scene", SCENES)
def test_errors_are_as_large_as_their_covariances_say(scene: str) -> None:
    name, overrides = SCENES[scene]
    made = load_scenario(name, {"observer.name": "robust", "horizon": 13.0, **overrides})
    nees = watched(made, SEEDS, 12, round(made.rates.camera), skipped=3, dtype="float32")[0]
    nees = np.nanmean(nees, axis=0)  # of each vehicle
    mean, error = nees.mean(axis=0), nees.std(axis=0, ddof=1) / np.sqrt(len(nees))
    least, most = EXPECTED.get(scene, (0.7, 1.05))
    assert (mean - 3.0 * error < most).all(), (mean, error)
    assert (mean + 3.0 * error > least).all(), (mean, error)


@pytest.mark.parametrize("name", ["busy_intersection_tracking", "lane:4", "random:6,seed=521"])
def test_no_vehicle_knows_more_than_there_is(name: str) -> None:
    """Its covariance is no smaller, in any direction, than the bound over it and all whose messages can reach it."""
    made = with_small_errors(load_scenario(name, {"horizon": 8.0, "noise.bearing.model": "isotropic"}))
    recording = record(made, 5)
    result, bound = run("robust", recording), cramer_rao_ancestors(recording)
    for k in range(100, recording.ticks, 60):
        for i in range(len(recording.setups)):
            least = eigvalsh(result.covariance[k, i], bound.covariance[k, i])[0]
            assert least > 0.9, (k, i, least)
    assert not result.failure
    assert (result.bytes_per_second * recording.period * recording.dt <= 8 * 28 * 1.001).all()  # in the mean
    size = [np.trace(P[-60:, :, 3:, 3:], axis1=2, axis2=3).mean(axis=0) for P in (result.covariance, bound.covariance)]
    assert (size[0] < 2.5 * size[1]).all(), size[0] / size[1]
