"""`robust` on the host, tick by tick, and embedded in a world: the same estimates from the same record."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from coopenv.bench.observers.convergence import random_start
from coopenv.observers import Recording, run
from coopenv.runs.recorder import record
from coopenv.scenario import load_scenario
from tests.helpers.four_way import FOUR_WAY
from tests.helpers.recordings import replayed

STALE = {"v2x.delay": 3, "v2x.loss": 0.4, "v2x.period": 2, "v2x.staleness": 0.2}
ISOTROPIC = {"noise.bearing.model": "isotropic", "noise.bearing.scale": 0.0029, "horizon": 4.0}
LASTING = {"noise.odometry_scale": 0.03, "noise.gyro_bias": (0.0, 0.0, 0.0087), "camera.extrinsics_error": 0.02}


def made(name: str, overrides: dict[str, Any], start: int | None = None) -> Recording:
    recording = record(load_scenario(name, {"horizon": 3.0, **overrides}), 0)
    return recording if start is None else random_start(recording, start)


RECORDS = {
    "any start": lambda: made("busy_intersection", ISOTROPIC, 2),
    "stale radio": lambda: made("busy_intersection_tracking", STALE),
    "slow corrections": lambda: made("busy_intersection_tracking", {"rates.observer": 25.0, "rates.odometry": 37.0}),
    "in circles": lambda: made("busy_intersection_tracking", {"topology.acyclic": False}),
    "errors that last": lambda: made("busy_intersection_tracking", LASTING),
    "clocks that are off": lambda: made("lane:4", {"faults.clock_offset": 0.05}),
    "driven": lambda: made(FOUR_WAY, {}),
}


@pytest.mark.parametrize("name", RECORDS)
def test_host_and_world_estimate_the_same(name: str) -> None:
    recording = RECORDS[name]()
    result, played = run("robust", recording), replayed(recording)
    assert not result.failure
    assert_allclose(played.position[1:], result.position[1:], rtol=0, atol=1e-9)
    assert_allclose(played.rotation[1:], result.rotation[1:], rtol=0, atol=1e-9)


def test_single_precision_worlds_estimate_alike() -> None:
    recording = RECORDS["any start"]()
    wide, narrow = replayed(recording), replayed(recording, dtype="float32")
    assert narrow.world.view("estimate_position").dtype == np.float32
    late = slice(-30, None)
    assert_allclose(narrow.position[late, :4], wide.position[late, :4], atol=2e-3)
    assert_allclose(narrow.rotation[late, :4], wide.rotation[late, :4], atol=2e-4)


def test_a_search_ends_for_leaders_first() -> None:
    played = replayed(RECORDS["any start"]())
    found = (~played.searching).argmax(axis=0)
    assert played.searching[0].all()
    assert 0 < found[0] < found[1] < found[2]
