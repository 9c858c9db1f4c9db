"""Processes that end, freeze and come back, over Zenoh: a gate, a fake car, a router."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import coopenv
from coopenv.cars.gate.wheel_command import read_drive
from coopenv.cars.link.transport import Arrival
from coopenv.cars.link.zenoh import open_zenoh
from coopenv.cars.messages.codec import decode
from coopenv.cars.settings.profile import SVEA, Role
from tests.helpers.cars import OVERTAKING
from tests.helpers.processes import COOPENV, ROOT, started, wait_until
from tests.helpers.wire import free_endpoint

pytestmark = pytest.mark.slow

AHEAD, FAST = (np.array([share, 0.0], dtype=np.float32) for share in (0.2, 1.0))
CAR_FILE = ROOT / "docker" / "car-zenoh.json5"
NEUTRAL = 500.0  # z of a ManualControl that asks for no speed


class Fleet:
    """A router and two fake cars, and an ear on what the gates let through."""

    def __init__(self, folder: Path, stack: ExitStack, *options: str) -> None:
        self.folder, self._stack, self.endpoint = folder, stack, free_endpoint()
        self.file, self._inside = folder / "fleet.toml", f"unixsock-stream/{folder}/car.sock"
        links = f'[network]\nconnect = ["{self.endpoint}"]\n[gate]\nconnect = ["{self._inside}"]\n'
        self.file.write_text(OVERTAKING + links)
        self.router = self.launch_router()
        self.cars = {car: self.launch_car(car, *options) for car in ("svea7", "svea1")}
        self.ear = open_zenoh("client", [self.endpoint])
        stack.callback(self.ear.close)
        self.manual: dict[str, list[tuple[float, float]]] = {car: [] for car in self.cars}
        self.speeds = dict.fromkeys(self.cars, 0.0)  # last commands, m/s
        for car in self.cars:
            self.ear.subscribe(SVEA.topic_of(car, Role.MANUAL), lambda arrival, car=car: self._keep(car, arrival))  # type: ignore[misc]

    def launch(self, line: str, *command: str) -> Any:
        """Start a command, and wait until its first line has a word in it."""
        return self._stack.enter_context(started(command, self.folder, line))

    def launch_router(self) -> Any:
        """Start a car's router with the shipped file; the gates connect to its unix socket."""
        listen = ("--listen", self.endpoint, "--listen", self._inside)
        return self.launch("ready", *COOPENV, "svea", "router", "--config", str(CAR_FILE), *listen)

    def launch_car(self, car: str, *options: str) -> Any:
        command = ("fake", str(self.file), "--car", car, "--connect", self._inside, *options)
        return self.launch("ready", *COOPENV, "svea", *command)

    def launch_gate(self, car: str) -> Any:
        return self.launch("ready", *COOPENV, "svea", "gate", str(self.file), "--car", car)

    def _keep(self, car: str, arrival: Arrival) -> None:
        z = float(decode(arrival.payload, SVEA.topics[Role.MANUAL].type).z)
        self.manual[car].append((time.monotonic(), z))
        self.speeds[car] = read_drive(arrival.payload, SVEA.command).speed

    def moves(self, car: str) -> bool:
        return bool(self.manual[car]) and self.manual[car][-1][1] < NEUTRAL - 1.0

    def neutral_since(self, car: str) -> float:
        """Return when the neutral commands began that a car has been getting since, monotonic, s."""
        driven = [t for t, z in self.manual[car] if abs(z - NEUTRAL) > 0.5]
        return min(t for t, _ in self.manual[car] if t > driven[-1])


@pytest.fixture
def fleet(tmp_path: Path) -> Iterator[Fleet]:
    with ExitStack() as stack:
        yield Fleet(tmp_path, stack)


def armed(fleet: Fleet) -> coopenv.CooperativeLocalisationEnv:
    env = coopenv.parallel_env(fleet.file, backend="svea")
    env.reset(seed=0, options={"arm": True})
    return env


def drive(env: coopenv.CooperativeLocalisationEnv, seconds: float, action: np.ndarray = AHEAD) -> dict[str, Any]:
    infos: dict[str, Any] = {}
    until = time.monotonic() + seconds
    while env.agents and time.monotonic() < until:
        infos = env.step(dict.fromkeys(env.agents, action))[-1]
    return infos


def test_a_car_that_freezes_is_noticed_and_the_others_stop(fleet: Fleet) -> None:
    env = armed(fleet)
    try:
        drive(env, 1.0)
        assert fleet.moves("svea7")
        os.kill(fleet.cars["svea1"].pid, signal.SIGSTOP)
        frozen = time.monotonic()
        infos = drive(env, 3.0)
        assert not env.agents and "svea1" in infos["vehicle_2"]["car"]["stopped"]
        backend = env.engine.backend
        assert backend.watchdog.trip is not None  # type: ignore[attr-defined]
        noticed = backend.watchdog.trip.time - frozen  # type: ignore[attr-defined]
        wait_until(lambda: not fleet.moves("svea7"))
        print(f"noticed after {1e3 * noticed:.0f} ms, svea7 neutral {fleet.neutral_since('svea7') - frozen:.3f} s")
        assert noticed < 0.4
    finally:
        os.kill(fleet.cars["svea1"].pid, signal.SIGCONT)
        env.close()


def test_a_gate_that_is_killed_stops_the_other_car(tmp_path: Path) -> None:
    with ExitStack() as stack:
        fleet = Fleet(tmp_path, stack, "--no-gate")
        gates = {car: fleet.launch_gate(car) for car in fleet.cars}
        env = armed(fleet)
        stack.callback(env.close)
        wait_until(lambda: fleet.speeds["svea7"] > 0.45, lambda: drive(env, 0.05, FAST))
        gates["svea1"].kill()
        killed = time.monotonic()
        infos = drive(env, 3.0, FAST)
        assert not env.agents and infos["vehicle_1"]["car"]["stopped"] == "svea1: is gone"
        wait_until(lambda: not fleet.moves("svea7"))
        taken = fleet.neutral_since("svea7") - killed
        print(f"svea7: neutral {1e3 * taken:.0f} ms after the death of svea1's gate")
        assert taken < 0.35


def test_a_router_that_dies_stops_all_and_arming_again_goes_on(fleet: Fleet) -> None:
    env = armed(fleet)
    try:
        drive(env, 1.0)
        fleet.router.kill()
        infos = drive(env, 5.0)
        assert not env.agents and infos["vehicle_1"]["car"]["stopped"]
        fleet.router.wait()
        fleet.router = fleet.launch_router()
        time.sleep(3.0)
        env.reset(seed=0, options={"arm": True})
        infos = drive(env, 1.0)
        assert env.agents and infos["vehicle_1"]["car"]["stopped"] == ""
        wait_until(lambda: fleet.moves("svea7"), lambda: drive(env, 0.1))
    finally:
        env.close()
