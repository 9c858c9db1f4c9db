"""`coopenv svea run` where something is not as it should be: real processes, real Zenoh."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from coopenv.base.errors import CoopenvError
from coopenv.cars.codec import encode, make
from coopenv.cars.fake.car import fault_topic
from coopenv.cars.fake.fleet import fakes, free_port
from coopenv.cars.transport.zenoh import open_zenoh
from coopenv.cli import app
from coopenv.cli.svea import STOPPED
from tests.helpers.processes import COOPENV, DEADLOCK, ROOT, start, wait_until

OVERTAKING = ROOT / "examples" / "fleet" / "overtaking.toml"
PATIENT = "odometry_age = 2.0\nmissed_deadlines = 60\n"


def test_cars_that_say_nothing_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    router = open_zenoh("router", listen=[endpoint])
    try:
        command = ["svea", "run", str(OVERTAKING), "--connect", endpoint, "--steps", "3", "--no-figures"]
        result = CliRunner().invoke(app, [*command, "--steady-from", "0"])
        too_short = CliRunner().invoke(app, command)
    finally:
        router.close()
    assert isinstance(result.exception, CoopenvError)
    assert str(result.exception).startswith(f"nothing has come from svea7, svea1 by {endpoint}")
    assert str(too_short.exception).startswith("steady_from 2 is not within the run of ")


@pytest.mark.slow
def test_a_car_that_is_killed_ends_the_run_with_a_status_of_its_own(tmp_path: Path) -> None:
    mine = tmp_path / "mine.toml"
    mine.write_text(OVERTAKING.read_text().replace("[safety]\n", f"[safety]\n{PATIENT}"))
    with fakes(mine) as endpoint:
        command = ("svea", "run", "mine.toml", "--connect", endpoint, "--arm", "--policy", "route_follower")
        station = start((*COOPENV, *command, "--record", "drive.mcap", "--no-figures"), tmp_path)
        wait_until(lambda: (tmp_path / "drive.mcap").exists() and (tmp_path / "drive.mcap").stat().st_size > 100_000)
        here = open_zenoh("client", [endpoint])
        here.publish(fault_topic("svea1"), encode(make("std_msgs/msg/String", data="kill@0")), reliable=True)
        printed, errors = station.communicate(timeout=DEADLOCK)
        here.close()
    assert station.returncode == STOPPED, errors
    assert "Stopped: svea1: " in printed and "ended before its time" in printed
