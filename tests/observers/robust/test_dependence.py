"""Whom a vehicle's estimate depends on, and what a sender counts that is met again."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from coopenv.scenario.files import load_scenario
from coopenv.world.world import World
from tests.helpers.builders import reset, simulate
from tests.helpers.robust_worlds import nees_of, steps_of

ROBUST = {"observer.name": "robust"}


def lane(name: str, **overrides: float) -> World:
    world = simulate(load_scenario(name, ROBUST | {"horizon": 3.0} | overrides), 2)
    reset(world)
    return world


def test_it_depends_on_those_that_it_has_heard() -> None:
    world = lane("lane:5,seen=2")
    memory: Any = world.memory
    world.advance(0)
    assert (memory.belief.numpy()["depends_on"] <= [0, 0b1, 0b11, 0b110, 0b1100]).all()  # at most on first messages
    world.advance(60)
    assert (memory.belief.numpy()["depends_on"] == [0, 0b1, 0b11, 0b111, 0b1111]).all()


def test_nobody_depends_on_who_is_not_heard() -> None:
    world = lane("lane:5,seen=2", **{"v2x.loss": 0.999999})
    world.advance(60)
    memory: Any = world.memory
    assert (memory.belief.numpy()["depends_on"] == 0).all()
    assert np.isfinite(world.view("estimate_position")).all() and np.isfinite(world.view("covariance")).all()


def test_nobody_in_a_lane_is_met_again() -> None:
    world = lane("lane:6,seen=3")
    memory: Any = world.memory
    for _ in range(20):
        world.advance(6)
        assert (memory.member.numpy()["correlation_unknown"] == 0).all()


def meeting(worlds: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return ANEES/6 (W,), the position error (W,) in m and how often a member in view is marked, sixteen cars."""
    found, marked = [], []
    for engine in steps_of("route_follower", load_scenario("large_crossing", ROBUST), worlds, 3):
        found.append(nees_of(engine.world))
        memory: Any = engine.world.memory
        marked.append(memory.member.numpy()["correlation_unknown"].mean())
    nees, errors = (np.array(part)[15:] for part in zip(*found, strict=True))
    return np.nanmean(nees, axis=(0, 2)), np.sqrt(np.nanmean(errors**2, axis=(0, 2))), np.array(marked)


@pytest.mark.slow
def test_cars_that_meet_again_and_again_know_how_well_they_stand() -> None:
    """Their ANEES/6 grew up to 3 and more while strangers' errors counted as independent."""
    nees, errors, marked = meeting(16)
    mean, std = nees.mean(), nees.std() / np.sqrt(len(nees))
    print(
        f"\nlarge_crossing: ANEES/6 {mean:.2f} +- {std:.2f}, {100 * errors.mean():.0f} cm, marked {marked.mean():.3f}"
    )
    assert marked.max() > 0.0
    assert mean - 2.0 * std < 1.3
