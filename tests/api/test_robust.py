"""The observer `robust` behind the faces: embedded where it can be, and no different as a plug-in."""

from __future__ import annotations

import pickle
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from pettingzoo.test import parallel_api_test

import coopenv
import coopenv.observers.registry as registry
from coopenv.api.engine import Engine
from coopenv.observers import find, register
from tests.helpers import mrclam_files
from tests.helpers.four_way import FOUR_WAY

CASES: dict[str, tuple[str, dict[str, Any]]] = {
    "the paper's start": ("busy_intersection", {"horizon": 3.0}),
    "radio": ("busy_intersection", {"horizon": 3.0, "v2x.delay": 3, "v2x.loss": 0.4, "v2x.period": 2}),
    "slow corrections": ("busy_intersection", {"horizon": 2.0, "rates.observer": 25.0}),
    "driven": (FOUR_WAY, {"horizon": 3.0}),
}
SAME = ("estimate_rotation", "estimate_position", "inbox_rotation", "inbox_position", "position_error")


@pytest.fixture(autouse=True)
def plugins(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(registry, "_registered", {})
    register("robust_on_the_host", find("robust"))
    yield


@pytest.mark.parametrize("case", CASES)
def test_embedded_and_plugged_in_are_the_same(case: str) -> None:
    name, overrides = CASES[case]
    names = ("robust", "robust_on_the_host")
    engines = [Engine(coopenv.load_scenario(name, {**overrides, "observer.name": n}), 1, "float64") for n in names]
    embedded, plugin = engines
    assert embedded.plugins is None and plugin.plugins is not None
    vehicles = len(embedded.world.scenario.vehicles)
    actions = np.linspace(-0.3, 0.6, 2 * vehicles).reshape(1, vehicles, 2)
    for engine in engines:
        engine.reset([5])
    for _ in range(embedded.world.scenario.horizon_ticks // 6):
        for engine in engines:
            engine.step(actions)
        for field in SAME:
            assert_allclose(plugin.view(field), embedded.view(field), rtol=0, atol=1e-9, err_msg=field)
        for field in ("covariance", "nees", "log_determinant", "gramian_min_eigenvalue"):
            assert_allclose(plugin.view(field), embedded.view(field), rtol=1e-6, atol=1e-9, err_msg=field)
        for field in ("observation", "reward"):
            assert_allclose(plugin.view(field), embedded.view(field), atol=1e-5, err_msg=field)


def test_official_test() -> None:
    parallel_api_test(coopenv.parallel_env(FOUR_WAY, observer="robust"), num_cycles=60)


def test_a_saved_environment_goes_on() -> None:
    env = coopenv.parallel_env("busy_intersection", observer="robust", overrides={"horizon": 4.0})
    env.reset(seed=1)
    still = {agent: np.zeros(2, dtype=np.float32) for agent in env.agents}
    for _ in range(10):
        env.step(still)
    saved = pickle.loads(pickle.dumps(env.get_state()))
    onward = [env.step(still)[0] for _ in range(10)]
    env.reset(seed=2)
    env.set_state(saved)
    for expected in onward:
        got = env.step(still)[0]
        assert all(np.array_equal(got[agent], expected[agent]) for agent in expected)


def test_batches_restart_what_is_over() -> None:
    overrides = {"observer.name": "robust", "horizon": 1.0}
    env = coopenv.make_vec("busy_intersection", num_worlds=3, overrides=overrides)
    env.reset(seed=0)
    for _ in range(25):
        observation = env.step(np.zeros((15, 2), dtype=np.float32))[0]
    assert np.isfinite(observation).all()
    assert (env.engine.view("episode") == 2).all()


def test_robots_on_a_plane_have_theirs_on_the_host(tmp_path: Path) -> None:
    mrclam_files.write(tmp_path, seconds=4.0)
    env = coopenv.parallel_env("mrclam_6", data=tmp_path, observer="planar_robust", dtype="float64")
    assert env.engine.plugins is not None
    env.reset(seed=0)
    while env.agents:
        observation = env.step({agent: np.zeros(2, dtype=np.float32) for agent in env.agents})[0]
    assert all(np.isfinite(value).all() for value in observation.values())
