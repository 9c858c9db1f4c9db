"""Batches in lanes: the truth of the worlds one by one bit for bit, what they measure and estimate within rounding."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
import pytest

from coopenv.scenario import Scenario, load_scenario
from coopenv.world.launch import width_of_lanes
from coopenv.world.world import World
from tests.helpers.builders import State, assert_same, reset, simulate
from tests.world.test_reproducibility import DRAWN, MADE, WALKING, noisy, played

TRUTH = ("position", "rotation", "velocity", "angular_velocity", "speed", "turn", "goal", "pan", "command")
SCENES = {
    "noise and losses": noisy(),
    "all that is drawn": noisy(WALKING, **DRAWN),
    "traffic with occluders": load_scenario("urban_crossing", {"observer.name": "riccati"}),
    "sensed topology": load_scenario("busy_intersection", {"topology.mode": "sensed"}),
}
pytestmark = pytest.mark.skipif(not width_of_lanes("cpu", "float32"), reason="a processor without AVX2")


def pair(description: Scenario, worlds: int, monkeypatch: pytest.MonkeyPatch) -> Iterator[World]:
    """Yield worlds in lanes, and worlds one by one."""
    for switch in ("1", "0"):
        monkeypatch.setenv("COOPENV_LANES", switch)
        world = simulate(description, worlds, "float32", 1)
        assert world.in_lanes == (switch == "1")
        yield world


def assert_alike(found: State, expected: State, tolerance: float) -> None:
    """Compare everything: truth, whole numbers and draws exactly, other numbers within rounding."""
    for name, values in expected.items():
        if name in TRUTH or values.dtype.kind != "f":
            np.testing.assert_array_equal(found[name], values, name)
        else:
            np.testing.assert_allclose(found[name], values, rtol=tolerance, atol=tolerance, err_msg=name)


@pytest.mark.parametrize(
    "scene",
    # Each of the others compiles modules of its own, for half a minute.
    [pytest.param(name, marks=() if name == "sensed topology" else pytest.mark.slow) for name in SCENES],
)
def test_worlds_in_lanes_are_worlds_one_by_one(scene: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Any worlds restart and are held, so that neighbours are at different ticks; 19 is no multiple of eight."""
    count, rng = 19, np.random.default_rng(1)
    lanes, others = pair(SCENES[scene], count, monkeypatch)
    for world in (lanes, others):
        world.reset(range(count))
    for turn in range(12):
        others.set_state(lanes.get_state())
        restarted, keys = rng.random(count) < 0.2, rng.integers(0, 2**63, count)
        actions, held = rng.uniform(-1, 1, lanes.actions.shape), rng.random(count) < 0.3
        for world in (lanes, others):
            world.reset(keys.tolist(), restarted)
        assert_same(lanes.get_state(), others.get_state())
        for world in (lanes, others):
            world.actions.assign(actions.astype(np.float32))
            world.mask.assign(held.astype(np.int32))
            world.advance(turn % 6 + 1)
            world.mask.zero_()
        assert_alike(lanes.get_state(), others.get_state(), 2e-4)
    assert len(np.unique(lanes.view("tick"))) > 3


def test_a_world_is_the_same_in_any_batch_in_lanes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever its neighbours, its lane, and the number of threads."""
    monkeypatch.setenv("COOPENV_LANES", "1")
    found = []
    for count, threads in ((64, 1), (64, 3), (9, 2)):
        world = simulate(MADE["riccati"], count, "float32", threads)
        reset(world, range(20 - count // 2, 20 - count // 2 + count))
        assert world.in_lanes
        found.append({name: values[count // 2 :][:1] for name, values in played(world, 60).items()})
    for one, other in pairwise(found):
        assert_same(one, other)


@pytest.mark.parametrize(
    ("worlds", "dtype", "switch"), [(7, "float32", "1"), (8, "float64", "1"), (8, "float32", "0"), (8, "float32", "")]
)
def test_worlds_that_are_computed_one_by_one(
    worlds: int, dtype: str, switch: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COOPENV_LANES", switch)
    assert not simulate(SCENES["noise and losses"], worlds, dtype, 1).in_lanes


def test_crowds_are_computed_one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Which agents a vehicle keeps differs between worlds there."""
    monkeypatch.setenv("COOPENV_LANES", "1")
    crowd = load_scenario("busy_intersection", {"topology.mode": "sensed", "topology.most_nearby": 4})
    assert not simulate(crowd, 8, "float32", 1).in_lanes
