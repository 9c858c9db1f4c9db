"""Commands in processes of their own."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
COOPENV = (sys.executable, "-m", "coopenv")
DEADLOCK = 60.0
"""s after which a test gives up."""


def start(command: Sequence[str], folder: Path, **options: Any) -> subprocess.Popen[str]:
    """Start a command that leads a process group of its own."""
    options = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **options}
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "80"}
    return subprocess.Popen(command, cwd=folder, text=True, env=environment, start_new_session=True, **options)


@contextmanager
def started(command: Sequence[str], folder: Path, line: str = "ready", **options: Any) -> Iterator[Any]:
    """Run a command until the block is left; its first line has had a text in it."""
    process = start(command, folder, **options)
    try:
        assert process.stdout is not None
        first = process.stdout.readline()
        assert line in first, (first, process.communicate(timeout=10))
        yield process
    finally:
        process.kill()
        process.communicate()


def wait_until(condition: Callable[[], object], meanwhile: Callable[[], object] = lambda: None) -> None:
    """Wait for a condition to hold; something is done before each look.

    Raises:
        TimeoutError: it does not come true.
    """
    give_up = time.monotonic() + DEADLOCK
    while True:
        meanwhile()
        if condition():
            return
        if time.monotonic() > give_up:
            raise TimeoutError
        time.sleep(0.01)


def _living() -> Iterator[tuple[int, int, str]]:
    """Yield number, process group and command line of every living process (Linux)."""
    for path in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # gone meanwhile
            state, _, group = (path / "stat").read_text().rpartition(")")[2].split()[:3]
            if state != "Z":
                line = (path / "cmdline").read_bytes().decode(errors="replace").replace("\0", " ")
                yield int(path.name), int(group), line


def group_of(leader: int) -> list[str]:
    """Return the command lines of the living processes of a process group but its leader."""
    return [line for number, group, line in _living() if group == leader != number]


def mentioning(text: str) -> list[str]:
    """Return the command lines of the living processes that have a text in them."""
    return [line for _, _, line in _living() if text in line]


def workers_of(leader: int) -> list[str]:
    """Return those that `multiprocessing` has started to work."""
    return [line for line in group_of(leader) if "spawn_main" in line]


@contextmanager
def small_disk(place: Path, size: str) -> Iterator[Path]:
    """Mount a new disk of a size such as `400k`; skip the test where that is not allowed."""
    place.mkdir()
    try:
        done = subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", place], capture_output=True)
    except OSError:
        pytest.skip("there is no `mount`")
    if done.returncode != 0:
        pytest.skip("needs the right to mount")
    try:
        yield place
    finally:
        subprocess.run(["umount", place], check=True)
