"""Fake cars and a station on a simulated clock: the same drive whatever the load, and the rules of safety in force."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import coopenv
from coopenv.cars.backend.backend import Svea
from coopenv.cars.fake.fleet import FakesError, prepare_fake
from coopenv.cars.fake.lockstep import Hub, LockstepFakes
from coopenv.cars.gate.process import GateConnection, prepare_gate
from coopenv.cars.gate.wheel_command import read_drive
from coopenv.cars.link.clock import SimulatedClock
from coopenv.cars.link.transport import Arrival
from coopenv.cars.settings.deployment import Safety, load_deployment
from coopenv.cars.settings.profile import SVEA, Role, presence_of
from tests.helpers.cars import OVERTAKING, SAFETY, cars, write_fleet
from tests.helpers.commands import refused

AHEAD = np.array([1.0, 0.0])  # 0.5 m/s
STALL = 0.05 * (Safety().missed_deadlines + 2)
"""s without a decision after which a station in real time stops its cars."""


def test_events_come_in_the_order_of_their_times_and_time_stands_still_in_between() -> None:
    clock, seen = SimulatedClock(), list[tuple[str, int]]()
    begin, wall = clock.steady(), clock.wall()

    def note(name: str) -> None:
        seen.append((name, (clock.steady() - begin) // 10**6))

    end_slow = clock.repeat(0.02, partial(note, "slow"), "slow")
    clock.repeat(0.01, partial(note, "fast"), "fast")
    clock.sleep(0.025)
    assert seen == [("fast", 10), ("slow", 20), ("fast", 20)]
    assert clock.steady() - begin == clock.wall() - wall == 25 * 10**6
    end_slow()
    end_slow()  # once more does no harm
    clock.sleep(0.015)
    assert seen[3:] == [("fast", 30), ("fast", 40)]


def drive(path: Path, stall: float) -> tuple[list[Any], str]:
    """Drive a second, and let the station stand still for a real time, s; return observations and why cars stopped."""
    fakes = LockstepFakes(path, seed=4)
    with closing(coopenv.parallel_env("cars", backend=fakes.station(), dtype="float64")) as env:
        seen, infos = [env.reset(seed=4, options={"arm": True})[0]], dict[str, Any]()
        for step in range(20):
            time.sleep(stall * (step == 10))
            observations, *_, infos = env.step(dict.fromkeys(env.agents, AHEAD))
            seen.append(observations)
    return seen, infos["vehicle_1"]["car"]["stopped"]


def test_a_seed_gives_the_same_drive_on_a_busy_computer(tmp_path: Path) -> None:
    path = write_fleet(tmp_path)
    (idle, _), (busy, stopped) = drive(path, 0.0), drive(path, STALL)
    assert stopped == "" and len(idle) == len(busy) == 21
    for one, other in zip(idle, busy, strict=True):
        for agent, values in one.items():
            np.testing.assert_array_equal(values, other[agent])


def test_a_station_that_makes_no_decisions_is_stopped_by_its_watchdog(tmp_path: Path) -> None:
    fakes = LockstepFakes(write_fleet(tmp_path))
    with closing(fakes.station()) as backend:
        backend.reset(0, {"arm": True})
        backend.watchdog.beat(0)
        for _ in range(40):
            backend.drain()
            fakes.clock.sleep(0.01)
        assert backend.watchdog.trip is not None and "no decision for 0.31 s" in backend.watchdog.trip.reason


def test_real_cars_are_not_driven_by_a_simulated_clock(tmp_path: Path) -> None:
    with pytest.raises(FakesError, match="fakes = true is missing"):
        LockstepFakes(write_fleet(tmp_path, OVERTAKING.replace("fakes = true", "")))
    line = refused("svea", "demo", "--port", "7447")
    assert "--port: cars on a simulated clock have no router; give --real-time, too" in line


class Bench:
    """Fakes whose gates are apart, as on a car with `coopenv svea fake --no-gate` beside `coopenv svea gate`."""

    def __init__(self, path: Path) -> None:
        self.clock = SimulatedClock()
        self.hub, self.ends, fleet = Hub(self.clock), dict[str, Any](), load_deployment(path)
        self.present, self.wheels = list[str](), list[Arrival]()
        self.hub.connect().watch("**", lambda name, there: self.present.append(name) if there else None)
        self.hub.connect().subscribe(SVEA.topic_of("svea7", Role.MANUAL), self.wheels.append)
        for car in fleet.cars:
            fake = prepare_fake(path, car.name, gate=False)(self.hub.connect())
            self.clock.join(partial(getattr, fake, "next"), fake.advance)
        assert not self.present
        for car in fleet.cars:
            link = self.hub.connect()
            gate = prepare_gate(fleet, car.name)(link, self.clock)
            tick = self.clock.repeat(0.05, gate.tick, "gate")
            news = self.clock.repeat(0.01, partial(self.report, gate), "news of a gate")
            self.ends[car.name] = link, tick, news

    @staticmethod
    def report(gate: GateConnection) -> None:
        if gate.news.is_set():
            gate.publish_status()

    def kill_gate(self, car: str) -> None:
        link, tick, news = self.ends[car]
        tick()
        news()
        link.close()


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[tuple[Bench, Svea]]:
    made = Bench(path := write_fleet(tmp_path, OVERTAKING, SAFETY))
    with closing(cars(path, made.hub)) as backend:
        yield made, backend


def speed(payload: bytes) -> float:
    return read_drive(payload, SVEA.command).speed


def test_a_gate_that_dies_stops_the_other_car_when_its_presence_goes(bench: tuple[Bench, Svea]) -> None:
    made, backend = bench
    assert sorted(made.present) == [presence_of(name) for name in ("station", "svea1", "svea7")]
    env = coopenv.parallel_env("cars", backend=backend, dtype="float64")
    env.reset(seed=0, options={"arm": True})
    while speed(made.wheels[-1].payload) < 0.45:
        env.step(dict.fromkeys(env.agents, AHEAD))
        assert env.agents
    made.kill_gate("svea1")
    died = made.clock.wall()
    while env.agents:
        env.step(dict.fromkeys(env.agents, AHEAD))
    made.clock.sleep(0.1)
    assert backend.watchdog.trip is not None and backend.watchdog.trip.reason == "svea1: is gone"
    stands = next(a.received for a in made.wheels if a.received > died and speed(a.payload) == 0.0)
    assert stands - died <= 60_000_000  # the watchdog's look and the gate's next output
