"""A library that steps at a known rate by a clock of its own, for a real worker process."""

from __future__ import annotations

import os
import time
from functools import cache

from benchmarks.speed.cases import Built, Case, Library

FAKE = Library("fake", "json", "tests.helpers.fake_library:build", ("pytest",))
STEP = 0.002
"""Wall time of a step, s."""
SHARE = 0.25
"""Part of it in which a core is busy."""


def fake_case(name: str = "fake", worlds: int = 3, **options: object) -> Case:
    return Case(name, FAKE.name, worlds, vehicles=2, dtype="float64", tick="scans", options=options)


class Clock:
    """The clock of a worker process whose time passes with the steps alone."""

    def __init__(self) -> None:
        self.wall = 0.0
        time.perf_counter = lambda: self.wall  # type: ignore[assignment]
        time.process_time = lambda: SHARE * self.wall  # type: ignore[assignment]


@cache
def clock() -> Clock:
    return Clock()


def build(case: Case) -> Built:
    print("libraries print whatever they like on standard output")
    if "import_error" in case.options:
        raise ImportError("no module\nof that name")
    if "tell" in case.options:
        raise ValueError(f"{case.options['tell']} is {os.environ[case.options['tell']]}")
    clock()
    steps_left = case.options.get("steps_left", 1 << 30)
    ballast = bytearray(case.options.get("bytes", 0))
    ballast[::4096] = b"x" * len(ballast[::4096])

    def step() -> int:
        nonlocal steps_left
        steps_left -= 1
        if steps_left < 0:
            os._exit(7)
        clock().wall += STEP + 0 * len(ballast)
        return 5 * case.worlds

    return Built(step, array_bytes=len(ballast) or None)
