"""An observer with kernels and a memory of its own comes from outside the package: functions, a struct, one call."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import numpy as np
import pytest
import warp as wp
from numpy.testing import assert_allclose

import coopenv
from coopenv.api.engine import Engine
from coopenv.backends.replay import Replay
from coopenv.base.errors import CoopenvError
from coopenv.observers import find, register, run
from coopenv.observers.registry import find_embedded
from coopenv.scenario.schema import neighbour_sets
from coopenv.world.embedded import Embedded, send_nothing
from coopenv.world.state import array
from tests.helpers.recordings import simulated


@wp.struct
class Counter:
    """What the toy remembers."""

    ticks: array("WN", wp.int32)
    heard: array("WN", wp.int32)


@wp.func
def start(model: Any, state: Any, memory: Any, world: int, vehicle: int):
    memory.ticks[world, vehicle] = 0
    memory.heard[world, vehicle] = 0


@wp.func
def estimate(model: Any, state: Any, memory: Any, world: int, vehicle: int, now: Any):
    """Count, and put the count where the position estimate stands."""
    memory.ticks[world, vehicle] = memory.ticks[world, vehicle] + 1
    for sender in range(model.vehicles):
        if state.inbox_tick[world, vehicle, sender] == now.tick:
            memory.heard[world, vehicle] = memory.heard[world, vehicle] + 1
    p = state.estimate_position[world, vehicle]
    p[0] = p.dtype(memory.ticks[world, vehicle])
    p[1] = p.dtype(memory.heard[world, vehicle])
    state.estimate_position[world, vehicle] = p


COUNTER = Embedded("toy_counter", estimate, start, send_nothing, Counter)
register(COUNTER.name, embedded=COUNTER)


@pytest.mark.parametrize("observer", ["toy_counter", COUNTER])
def test_it_runs_in_an_environment(observer: str | Embedded) -> None:
    env = coopenv.parallel_env("busy_intersection", observer=observer, dtype="float64")
    env.reset(seed=0)
    env.step({agent: np.zeros(2) for agent in env.agents})
    memory = env.engine.world.memory
    ticks = env.engine.world.model.ticks_per_decision
    assert memory.ticks.numpy().tolist() == [[ticks] * 5]
    leaders = [sum(target >= 3 for target in targets) for targets in neighbour_sets(env.scenario)]
    assert memory.heard.numpy()[0].tolist() == [ticks * count for count in leaders]
    assert env.engine.view("estimate_position")[0, :, 0].tolist() == [ticks] * 5
    env.reset(seed=0)
    assert not memory.ticks.numpy().any()


def test_batch_replay_and_saved_states_keep_its_memory() -> None:
    rows = coopenv.make_vec(
        "busy_intersection", num_worlds=3, dtype="float64", overrides={"observer.name": "toy_counter"}
    )
    rows.reset(seed=0)
    rows.step(rows.action_space.sample())
    assert (rows.engine.world.memory.ticks.numpy() == rows.engine.world.model.ticks_per_decision).all()
    state = rows.engine.get_state()
    rows.step(rows.action_space.sample())
    rows.engine.set_state(state)
    assert np.array_equal(rows.engine.get_state()["observer_ticks"], state["observer_ticks"])
    recording = simulated()
    replay = Replay(recording, "second", {"observer.name": "toy_counter"})
    engine = Engine(replay.scenario, dtype="float64", backend=replay)
    engine.reset()
    engine.step(ticks=7)
    assert engine.world.memory.ticks.numpy().tolist() == [[7] * 5]


def test_it_is_compared_with_others() -> None:
    recording = simulated()
    for observer in ("toy_counter", COUNTER):
        result = run(observer, recording)
        assert not result.failure
        counted = np.einsum("knji,knj->kni", result.rotation, result.position)
        assert (counted[1:, :, 0] == np.arange(1, recording.ticks)[:, None]).all()
        leaders = [(setup.targets >= 3).sum() for setup in recording.setups]
        assert_allclose(counted[1:, :, 1], np.arange(1, recording.ticks)[:, None] * leaders)
        assert (result.bytes_per_second > 0).all()


def test_a_saved_plug_in_goes_on() -> None:
    recording = simulated()
    observer = find("toy_counter")(recording.setups[0])
    observer.reset((np.eye(3), np.zeros(3)), np.eye(6))
    for k in range(1, 10):
        observer.update(recording.tick(k, 0, {}))
    for copied in (copy.deepcopy(observer), pickle.loads(pickle.dumps(observer))):
        assert copied.update(recording.tick(10, 0, {})).position[0] == 10.0
    assert observer.update(recording.tick(10, 0, {})).position[0] == 10.0


def test_names_are_taken_once() -> None:
    register("toy_counter", embedded=COUNTER)
    for name in ("robust", "toy_counter"):
        with pytest.raises(CoopenvError, match=f"'{name}' exists already"):
            register(name, embedded=Embedded(name, estimate, start, send_nothing))
    with pytest.raises(CoopenvError, match="expected a class, a function or an Embedded"):
        register("nothing")
    assert find_embedded("toy_counter") is COUNTER and find_embedded("mekf") is None
