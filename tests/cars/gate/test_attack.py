"""A fleet of fakes whose gates are processes of their own, behind a router with a car's configuration, under attack."""

from __future__ import annotations

import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

import pytest

from tests.helpers.cars import OVERTAKING, PATIENT
from tests.helpers.processes import COOPENV, ROOT, start, started
from tests.helpers.wire import free_endpoint

pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform != "linux", reason="unix sockets")]
CARS = ("svea7", "svea1")


def run(folder: Path, *command: str) -> subprocess.CompletedProcess[str]:
    process = start((*COOPENV, "svea", *command), folder)
    out, errors = process.communicate(timeout=300)
    return subprocess.CompletedProcess(command, process.returncode, out, errors)


def test_nothing_moves_a_car_and_the_station_drives(tmp_path: Path) -> None:
    inside, outside = f"unixsock-stream/{tmp_path}/car.sock", free_endpoint()
    links = f'[network]\nconnect = ["{outside}"]\n[gate]\nconnect = ["{inside}"]\n[security]\nkeys = "keys"\n'
    (tmp_path / "fleet.toml").write_text(OVERTAKING + links + PATIENT)
    assert run(tmp_path, "keys", "fleet.toml").returncode == 0
    config = str(ROOT / "docker" / "car-zenoh.json5")
    commands = [("router", "--config", config, "--listen", inside, "--listen", outside)]
    commands += [("fake", "fleet.toml", "--car", car, "--no-gate", "--connect", inside) for car in CARS]
    commands += [("gate", "fleet.toml", "--car", car) for car in CARS]
    with ExitStack() as stack:
        for command in commands:
            stack.enter_context(started((*COOPENV, "svea", *command), tmp_path))
        drive = ("run", "fleet.toml", "--arm", "--policy", "route_follower", "--no-figures", "--steps", "60")
        for _ in range(2):
            done = run(tmp_path, *drive)
            assert done.returncode == 0, done.stderr
            attacked = run(tmp_path, "attack", "fleet.toml")
            print(attacked.stdout)
            assert attacked.returncode == 0, attacked.stdout
            assert max(map(len, attacked.stdout.splitlines())) <= 80
            assert "0 of 26 kinds got through" in attacked.stdout
            health = run(tmp_path, "health", "fleet.toml", "--car", "svea7")
            assert (health.returncode, health.stdout.count("does not get through")) == (0, 1)
