"""A thread per share of the vehicles of a world: the same bits as one thread that takes all of them in turn."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from coopenv.api.engine import Engine
from coopenv.base.errors import CoopenvError
from coopenv.world import launch
from coopenv.world.launch import threads_and_lanes
from coopenv.world.step import follow_kernels
from coopenv.world.world import World
from tests.helpers.builders import assert_same, reset, simulate
from tests.world.test_nearby import street
from tests.world.test_reproducibility import MADE, played

STREETS: dict[str, dict[str, Any]] = {
    "messages of earlier ticks": {"v2x": {"delay": 1, "range": 30.0, "loss": 0.3}},
    "messages of this tick": {"topology": {"acyclic": True}, "v2x": {"delay": 0, "range": 20.0}},
    "messages of this tick to all": {"v2x": {"delay": 0, "range": 20.0, "links": "all", "period": 2}},
}


@pytest.fixture
def _small_lanes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(launch, "VEHICLES_PER_THREAD", 1)
    monkeypatch.setattr("coopenv.world.world.VEHICLES_PER_LEVEL", 2)  # some levels at once, some in turn


@pytest.mark.parametrize("variant", STREETS)
@pytest.mark.parametrize("observer", ["riccati", pytest.param("robust", marks=pytest.mark.slow)])
@pytest.mark.usefixtures("_small_lanes")
def test_vehicles_at_once_are_vehicles_in_turn(variant: str, observer: str) -> None:
    description, found = street(60, 96, observer, **STREETS[variant]), []
    for threads in (1, 2, 3):
        world = simulate(description, 1, "float32", threads)
        assert world.launch.lanes == threads
        reset(world, [4])
        for _ in range(6):
            world.advance(6)
        found.append(world.get_state())
    assert_same(found[0], found[1])
    assert_same(found[0], found[2])
    assert (found[0]["inbox_tick"] > 0).any()


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["messages of earlier ticks", "messages of this tick"])
def test_parts_of_an_observer_are_the_whole(variant: str) -> None:
    """As on a GPU: each part of a tick is a kernel of its own, which finds all that it needs in memory."""
    description = street(60, 64, "robust", **STREETS[variant])
    whole, parts = (simulate(description, 1, "float32", 1) for _ in range(2))
    parts.in_parts = True
    for world in (whole, parts):
        reset(world, [4])
        for _ in range(20):
            world.advance(6)
    assert len(follow_kernels(whole.observer, whole.precision, True)) == 5
    assert_same(whole.get_state(), parts.get_state())


@pytest.mark.parametrize("name", MADE)
@pytest.mark.usefixtures("_small_lanes")
def test_few_vehicles_of_two_worlds(name: str) -> None:
    found = []
    for threads in (1, 3):
        world = simulate(MADE[name], 2, threads=threads)
        reset(world, range(2))
        assert world.launch.lanes == threads
        found.append(played(world, 60))
    assert_same(*found)


@pytest.mark.usefixtures("_small_lanes")
def test_results_of_a_step() -> None:
    description, found = street(60, 96), []
    for threads in (1, 2):
        engine = Engine(description, 1, threads=threads)
        engine.reset([3])
        for _ in range(3):
            engine.step(np.full(engine.world.actions.shape, 0.3, np.float32))
        found.append({name: engine.view(name).copy() for name in ("observation", "reward", "nees", "truncated")})
        engine.close()
    assert_same(*found)


def longest_chain(world: World, vehicle: int, tick: int) -> int:
    """Return how many messages of a tick one after the other lead to a vehicle, by recursion."""
    senders = np.flatnonzero(world.view("arriving")[0, vehicle] == tick).tolist()
    return max((1 + longest_chain(world, sender, tick) for sender in senders), default=0)


@pytest.mark.usefixtures("_small_lanes")
def test_levels_are_the_longest_chains_of_messages() -> None:
    world = simulate(street(60, 64, v2x={"delay": 0, "range": 12.0}), 1, threads=2)
    reset(world, [0])
    world.advance(5)
    levels = [longest_chain(world, vehicle, 5) for vehicle in range(64)]
    turns, first = world._turns.vehicle.numpy()[0], world._turns.first.numpy()[0]
    assert turns.tolist() == np.argsort(levels, kind="stable").tolist()
    assert first.tolist() == np.searchsorted(np.sort(levels), np.arange(65)).tolist()
    assert max(levels) > 1


@pytest.mark.parametrize(
    ("worlds", "vehicles", "device", "threads", "expected"),
    [
        (1, 5, "cpu", 4, (1, 1)),
        (1, 5, "cpu", None, (1, 1)),
        (1, 127, "cpu", 4, (1, 1)),
        (1, 1024, "cpu", 4, (1, 4)),
        (3, 1024, "cpu", 4, (1, 4)),
        (4, 1024, "cpu", 4, (4, 1)),
        (1, 192, "cpu", 4, (1, 3)),
        (3, 5, "cpu", 4, (3, 1)),
        (1, 1024, "cuda:0", None, (1, 1024)),
        (65536, 5, "cuda:0", None, (1, 1)),
    ],
)
def test_threads_and_lanes_of_batches(
    worlds: int, vehicles: int, device: str, threads: int | None, expected: tuple[int, int]
) -> None:
    assert threads_and_lanes(worlds, vehicles, device, threads) == expected


def test_cores_are_used_by_default(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COOPENV_THREADS", "4")
    assert threads_and_lanes(1, 1024, "cpu") == (1, 4)
    assert threads_and_lanes(64, 5, "cpu") == (2, 1)
    assert threads_and_lanes(128, 1024, "cpu") == (4, 1)


@pytest.mark.parametrize("wanted", ["0", "-1", "1025", "100000", "9" * 5000, "two", "4.0"])
def test_a_number_of_threads_that_no_machine_has_is_refused(monkeypatch: pytest.MonkeyPatch, wanted: str) -> None:
    monkeypatch.setenv("COOPENV_THREADS", wanted)
    with pytest.raises(CoopenvError, match="COOPENV_THREADS must be a whole number from 1 to 1024, got ") as caught:
        threads_and_lanes(1, 1024, "cpu")
    assert len(str(caught.value)) < 150
