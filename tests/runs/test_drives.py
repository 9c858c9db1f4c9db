"""`coopenv svea run --record` that is interrupted or killed, and `coopenv run` of what it leaves: real processes."""

from __future__ import annotations

import json
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from coopenv.cars.fake.fleet import fakes
from tests.helpers.cars import write_fleet
from tests.helpers.processes import COOPENV, DEADLOCK, start, wait_until

pytestmark = pytest.mark.slow

ENOUGH = 200_000
"""Bytes of a record in which an episode has begun."""


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, str]]:
    path = write_fleet(tmp_path_factory.mktemp("fleet"))
    with fakes(path) as router:
        yield path, router


def interrupted(fleet: tuple[Path, str], folder: Path, number: signal.Signals) -> tuple[str, int]:
    """Drive and record, send a signal on the way, and return what it says then and its status."""
    path, router = fleet
    options = ("--arm", "--policy", "route_follower", "--record", "drive.mcap", "--out", "out")
    process = start((*COOPENV, "svea", "run", str(path), "--connect", router, *options), folder)
    try:
        drive = folder / "drive.mcap"
        wait_until(lambda: process.poll() is not None or (drive.exists() and drive.stat().st_size > ENOUGH))
        process.send_signal(number)
        _, errors = process.communicate(timeout=DEADLOCK)
    finally:
        process.kill()
    return errors, process.returncode


def replayed(folder: Path) -> tuple[str, str]:
    process = start((*COOPENV, "run", "drive.mcap", "--no-figures", "--out", "again"), folder)
    told, errors = process.communicate(timeout=2 * DEADLOCK)
    assert process.returncode == 0, errors
    return told, errors


def test_what_an_interrupt_keeps_is_told_and_can_be_shown(fleet: tuple[Path, str], tmp_path: Path) -> None:
    errors, status = interrupted(fleet, tmp_path, signal.SIGINT)
    assert status == 130
    assert errors.splitlines()[-1] == "interrupted; kept: drive.mcap, the drive up to here: coopenv run drive.mcap"
    assert [path.name for path in tmp_path.iterdir()] == ["drive.mcap"]
    told, errors = replayed(tmp_path)
    assert "Stopped: Interrupted\n" in told and "warning" not in errors
    assert json.loads((tmp_path / "again" / "metrics.json").read_text())["policy"] == "recorded"


def test_a_station_that_is_killed_leaves_its_drive(fleet: tuple[Path, str], tmp_path: Path) -> None:
    _, status = interrupted(fleet, tmp_path, signal.SIGKILL)
    assert status == -9
    told, errors = replayed(tmp_path)
    (warning,) = (line for line in errors.splitlines() if line.startswith("warning"))
    assert "drive.mcap: cut off, the end of the MCAP file is missing: of what came after " in warning
    assert "ended before its time" in told and "RMSE" in told
