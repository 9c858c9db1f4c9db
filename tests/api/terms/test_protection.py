"""Protection levels in observations and infos, of an observer on the host that states what the test tells it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

import coopenv
import coopenv.observers.registry as registry
from coopenv.observers import Estimate, register
from coopenv.observers.single_frame import DeadReckoning

INF = float("inf")
GROUP = {"observation.include": ["protection"], "noise.enabled": False}


@pytest.fixture
def stated(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[Any]]:
    """Yield a list whose only entry `stating` states as its protection level."""
    level: list[Any] = [None]

    class Stating(DeadReckoning):
        def update(self, tick: Any) -> Estimate:
            return replace(super().update(tick), protection_level=level[0])

    monkeypatch.setattr(registry, "_registered", {})
    register("stating", Stating)
    yield level


@pytest.mark.parametrize(
    ("level", "position", "angle"),
    [
        ((10.0**-0.5, 10.0**-1.5), 0.0, 0.0),
        ((1.0, 0.01), 1 / 3, -1 / 3),
        ((10.0, 1.0), 1.0, 1.0),
        ((1e-9, 1e-9), -1.0, -1.0),
        ((INF, INF), 1.0, 1.0),
        (None, 1.0, 1.0),
    ],
)
def test_values_and_infos(stated: list[Any], level: Any, position: float, angle: float) -> None:
    stated[0] = level
    known = level or (INF, INF)
    env = coopenv.parallel_env("busy_intersection", observer="stating", overrides=GROUP)
    _, infos = env.reset(seed=0)
    assert infos["vehicle_1"]["protection_level"] == [INF, INF]
    observations, _, _, _, infos = env.step({agent: np.zeros(2, np.float32) for agent in env.agents})
    for agent, seen in observations.items():
        assert_allclose(seen, [position, angle], atol=1e-6)
        assert infos[agent]["protection_level"] == list(known)
    envs = coopenv.make_vec("busy_intersection", num_worlds=2, overrides={**GROUP, "observer.name": "stating"})
    envs.reset(seed=0)
    rows, *_, infos = envs.step(np.zeros((envs.num_envs, 2), np.float32))
    assert_allclose(rows, np.tile([position, angle], (envs.num_envs, 1)), atol=1e-6)
    assert_allclose(infos["protection_level"], np.tile(known, (envs.num_envs, 1)))
