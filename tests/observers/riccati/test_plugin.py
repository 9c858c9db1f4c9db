"""The plug-in Riccati observer is the embedded one, and one written in NumPy, tick by tick."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from coopenv.api.engine import Engine
from coopenv.observers import run
from coopenv.runs.recorder import record
from coopenv.scenario import Scenario, load_scenario
from tests.helpers.four_way import FOUR_WAY
from tests.oracles.batch import small_errors
from tests.oracles.riccati import Riccati

CASES: dict[str, dict[str, Any]] = {
    "the paper's start": {"horizon": 8.0},
    "radio": {"horizon": 3.0, "v2x.delay": 3, "v2x.loss": 0.4, "v2x.period": 2, "v2x.staleness": 0.2},
    "gain and slow corrections": {"horizon": 3.0, "observer.k": 2.0, "rates.observer": 25.0},
    "cyclic": {"horizon": 2.0, "topology.acyclic": False},
}


def embedded(scenario: Scenario, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    engine = Engine(scenario, 1, "float64")
    engine.reset([seed])
    rows = []
    for _ in range(scenario.horizon_ticks):
        engine.step(ticks=1)
        names = ("estimate_rotation", "estimate_position", "covariance", "nees")
        rows.append([engine.view(name)[0].copy() for name in names])
    return tuple(np.array(column) for column in zip(*rows, strict=True))  # type: ignore[return-value]


def assert_agrees(scenario: Scenario) -> None:
    R, p, P, nees = embedded(scenario, 5)
    recording = record(scenario, 5)
    for observer in ("riccati", Riccati):
        result = run(observer, recording)
        assert not result.failure
        assert_allclose(result.rotation[1:], R, atol=1e-9)
        assert_allclose(result.position[1:], (R @ p[..., None])[..., 0], atol=1e-9)
        assert_allclose(result.covariance[1:], P, atol=1e-9)
        assert_allclose(result.nees[1:], nees, rtol=1e-6, atol=1e-9)
        assert (result.bytes_per_second == 24.0 / recording.dt / recording.period).all()


@pytest.mark.parametrize("case", CASES)
def test_it_is_the_embedded_observer(case: str) -> None:
    assert_agrees(load_scenario("busy_intersection", CASES[case]))


def test_it_is_the_embedded_observer_with_camera_and_markers_off_centre() -> None:
    assert_agrees(small_errors({"horizon": 2.0, "noise.bearing.scale": 0.003}, size=0.5))


def test_hamel_samson_is_the_riccati_observer_without_neighbours() -> None:
    """Vehicle 1 sees landmarks only; for the others it must not change with what neighbours say."""
    recording = record(load_scenario("busy_intersection", {"horizon": 1.0}), 0)
    alone, together = run("hamel_samson", recording), run("riccati", recording)
    assert_allclose(alone.position[:, 0], together.position[:, 0], rtol=0, atol=1e-12)
    assert np.abs(alone.position[-1, 1:] - together.position[-1, 1:]).max(axis=1).min() > 0.01
    assert (alone.bytes_per_second == 0).all()


@pytest.mark.parametrize("name", [FOUR_WAY, "crossing_path"])
def test_it_is_the_embedded_observer_where_sight_is_sensed_and_vehicles_are_driven(name: str) -> None:
    scenario = load_scenario(name, {"horizon": 3.0})
    actions = np.linspace(-0.3, 0.6, 2 * len(scenario.vehicles)).reshape(1, -1, 2)
    engine = Engine(scenario, 1, "float64")
    engine.reset([5])
    recording = record(scenario, 5, lambda _: actions[0])
    result = run("riccati", recording)
    assert not recording.visible.all()
    for k in range(1, scenario.horizon_ticks + 1):
        engine.set_actions(actions)
        engine.step(ticks=1)
        assert_allclose(result.rotation[k], engine.view("estimate_rotation")[0], atol=1e-9)
        assert_allclose(result.covariance[k], engine.view("covariance")[0], atol=1e-9)
        assert_allclose(result.position_error[k], engine.view("position_error")[0], atol=1e-9)
