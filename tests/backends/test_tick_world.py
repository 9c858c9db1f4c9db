"""The batched backends told tick by tick: the same worlds, so that a source of ticks is as good as a device."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

import coopenv
from coopenv import CoopenvError
from coopenv.api.engine import Engine
from coopenv.backends.base import Backend, Command
from coopenv.backends.replay import Replay
from coopenv.backends.simulated import Simulated
from coopenv.backends.tick_world import TickWorld, open_world
from coopenv.runs import record
from tests.helpers.four_way import FOUR_WAY
from tests.helpers.recordings import simulated

CASES: dict[str, tuple[str, dict[str, Any]]] = {
    "radio": ("busy_intersection", {"v2x.delay": 2, "v2x.loss": 0.2, "v2x.period": 2, "v2x.staleness": 0.2}),
    "driven": (FOUR_WAY, {"dynamics.latency": 0.05}),
    "accelerations": (FOUR_WAY, {"action.longitudinal": "acceleration"}),
    "slow corrections": ("crossing_path", {"rates.observer": 25.0, "rates.odometry": 37.0}),
    "robust": ("busy_intersection", {"observer.name": "robust"}),
    "plug-in": ("busy_intersection", {"observer.name": "mekf", "v2x.loss": 0.2}),
}
EXACT = ("tick", "inbox_tick", "bearing_tick", "odometry_samples", "alive", "terminated", "truncated")
CLOSE = ("observation", "reward", "collided", "estimate_rotation", "estimate_position", "covariance", "position_error")


def tick_by_tick(backend: Any) -> Backend:
    """Return a backend that does not make worlds itself."""
    backend.capabilities = replace(backend.capabilities, batched=False)
    return backend


@pytest.mark.parametrize("case", CASES)
def test_a_simulated_world_told_tick_by_tick_is_the_one_on_the_device(case: str) -> None:
    name, overrides = CASES[case]
    scenario = coopenv.load_scenario(name, {"horizon": 1.0, **overrides})
    engines = [Engine(scenario, 1, "float64")]
    engines.append(Engine(scenario, 1, "float64", backend=tick_by_tick(Simulated(scenario))))
    assert isinstance(engines[1].world, TickWorld) and not isinstance(engines[0].world, TickWorld)
    rng = np.random.default_rng(0)
    for seeds in ([5], None):  # and the next episode of that seed
        for engine in engines:
            engine.reset(seeds)
        for _ in range(11):
            first, second = engines
            for field in EXACT:
                assert np.array_equal(first.view(field), second.view(field)), field
            for field in CLOSE:
                assert_allclose(second.view(field), first.view(field), rtol=1e-6, atol=1e-9, err_msg=field)
            actions = rng.uniform(-1, 1, (1, len(scenario.vehicles), 2))
            for engine in engines:
                engine.step(actions)


@pytest.mark.parametrize("observer", ["riccati", "mekf"])
def test_a_recording_told_tick_by_tick_is_the_one_on_the_device(observer: str) -> None:
    recording = simulated("busy_intersection", 3, v2x__loss=0.3)
    options = {"observer.name": observer}
    backends = [Replay(recording, "drive", options), tick_by_tick(Replay(recording, "drive", options))]
    engines = [Engine(backend.scenario, 1, "float64", backend=backend) for backend in backends]
    for engine in engines:
        engine.reset([3])  # whose initial estimates the recording has
    for _ in range(11):
        for field in EXACT:
            assert np.array_equal(engines[0].view(field), engines[1].view(field)), field
        for field in CLOSE:
            assert_allclose(engines[1].view(field), engines[0].view(field), rtol=1e-6, atol=1e-9, err_msg=field)
        for engine in engines:
            engine.step(np.zeros((1, len(recording.setups), 2)))
    assert backends[1].health.ticks == recording.ticks


def test_a_recording_of_a_recording_is_the_recording() -> None:
    recording = simulated(FOUR_WAY, 1, v2x__loss=0.2)
    for backend in (Replay(recording, "drive"), tick_by_tick(Replay(recording, "drive"))):
        again = record(backend, 1)
        for name in ("rotation", "translation", "velocity", "bearings", "visible", "landmarks", "inbox_tick", "due"):
            assert np.array_equal(getattr(again, name), getattr(recording, name), equal_nan=True), name
        assert_allclose(again.truth.position, recording.truth.position, atol=1e-12)
        assert_allclose(again.start_position, recording.start_position, atol=1e-12)


def test_commands_and_their_rows() -> None:
    rows = np.arange(8.0).reshape(2, 4)
    for command in (Command.of(rows), Command.of(rows[:, :3])):
        assert command.speed.tolist() == [0, 4] and command.steering.tolist() == [1, 5]
        assert command.acceleration.tolist() == [2, 6]
        pan = [0, 0] if command.pan is None else command.pan
        assert np.array_equal(command.rows, np.column_stack([rows[:, :3], pan]))
    assert np.array_equal(Command.of(rows).rows, rows)


def test_it_is_one_world_on_the_cpu() -> None:
    backend = tick_by_tick(Simulated(coopenv.load_scenario("overtaking")))
    with pytest.raises(CoopenvError, match="backend Simulated gives the ticks of one world to the CPU, not of 3 "):
        open_world(backend, 3, "float32", "cpu", None)


def test_a_stopped_source_has_no_more_ticks() -> None:
    scenario = coopenv.load_scenario("overtaking", {"horizon": 1.0})
    backend = Simulated(scenario)
    first = backend.reset(0, {})
    command = Command.of(np.zeros((2, 3)))
    ticks = list(backend.advance(command))
    assert (first.index, [tick.index for tick in ticks]) == (0, [1, 2, 3, 4, 5, 6])
    assert backend.clock == pytest.approx(0.1) and backend.health.ticks == 7
    backend.stop("enough")
    backend.stop("enough")
    assert list(backend.advance(command)) == []
    assert backend.reset(0, {}).index == 0
    assert len([tick for _ in range(12) for tick in backend.advance(command)]) == scenario.horizon_ticks
