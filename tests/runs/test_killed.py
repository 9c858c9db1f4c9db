"""Commands that are killed at random instants while they replace an earlier result."""

from __future__ import annotations

import json
import os
import random
import signal
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from coopenv.backends.mcap import read_recording
from coopenv.estimation.observability import Trajectory
from coopenv.runs.command import result_names
from tests.helpers.processes import COOPENV, start

SHORT = ["overtaking", "--set", "horizon=0.5"]


def seed_of_run(folder: Path) -> int:
    """Return the seed of a whole result of `coopenv run`: every figure is of that size, the arrays of that seed."""
    metrics = json.loads((folder / "metrics.json").read_text())
    run = Trajectory.load(folder / "trajectory.npz")
    final = [vehicle["final_position_error_m"] for vehicle in metrics["vehicles"]]
    assert np.array_equal(run.position_error[-1], final)
    names = {path.name for path in folder.iterdir()}
    assert len(names) == 10 and names <= set(result_names())
    pictures = {name: folder.joinpath(name).stat().st_mtime_ns for name in names if name.endswith(".png")}
    assert len(pictures) == 6
    for name in pictures:
        with Image.open(folder / name) as image:
            image.load()
    written = (folder / "metrics.json").stat().st_mtime_ns
    assert all(0 <= time - written < 60e9 for time in pictures.values()), "figures of another run"
    return int(metrics["seed"])


def seed_of_log(path: Path) -> int:
    """Return the seed of a whole MCAP file, which its scenario's title carries here."""
    return int(read_recording(path).scenario.title)


def seed_of_board(folder: Path) -> int:
    """Return the number of seeds of a whole leaderboard."""
    board = json.loads((folder / "leaderboard.json").read_text())
    lines = (folder / "leaderboard.csv").read_text().splitlines()
    assert len(lines) == 1 + len(board["rows"])
    report = (folder / "report.html").read_text()
    assert report.rstrip().endswith("</html>")
    assert f"--seeds {len(board['seeds'])}" in report
    return len(board["seeds"])


def run(seed: int) -> list[str]:
    return ["run", *SHORT, "--seed", str(seed), "--out", "result"]


def record(seed: int) -> list[str]:
    return ["record", *SHORT, "--set", f'title="{seed}"', "--force", "--out", "result.mcap"]


def board(seeds: int) -> list[str]:
    observers = ["--observers", "riccati", "--variants", "nominal", "--seeds", str(seeds), "--jobs", "1"]
    return ["bench", "observers", *SHORT, *observers, "--out", "result"]


COMMANDS: dict[str, tuple[Callable[[int], list[str]], str, Callable[[Path], int]]] = {
    "run": (run, "result", seed_of_run),
    "record": (record, "result.mcap", seed_of_log),
    "bench observers": (board, "result", seed_of_board),
}


PAGES = {"record": ["result.html"]}
"""Files beside a command's result."""


def kill_at_random(command: str, kills: int, folder: Path) -> None:
    """Kill a command again and again while it replaces an earlier result."""
    arguments, name, read = COMMANDS[command]
    begin = time.monotonic()
    assert start((*COOPENV, *arguments(1)), folder).wait(120) == 0
    duration = time.monotonic() - begin
    assert read(folder / name) == 1
    draw, before, survived = random.Random(7), 1, 0
    for _ in range(kills):
        process = start((*COOPENV, *arguments(3 - before)), folder)
        time.sleep(duration * draw.uniform(0.0, 1.05))
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        after = read(folder / name)
        survived += after == before
        before = after
    assert survived > 0, "never killed before the end"
    assert start((*COOPENV, *arguments(2)), folder).wait(120) == 0
    assert read(folder / name) == 2
    pages = PAGES.get(command, [])
    assert all((folder / page).read_text().rstrip().endswith("</html>") for page in pages)
    assert {path.name for path in folder.iterdir()} == {name, *pages}


@pytest.mark.slow
@pytest.mark.parametrize(("command", "kills"), [("run", 50), ("record", 20), ("bench observers", 20)])
def test_killed_commands_leave_a_whole_result(command: str, kills: int, tmp_path: Path) -> None:
    kill_at_random(command, kills, tmp_path)
