"""A library that steps at a known rate, for a real worker process."""

from __future__ import annotations

import os
import time

from benchmarks.speed.cases import Built, Case, Library

FAKE = Library("fake", "json", "tests.benchmarks.fake_library:build", ("pytest",))
STEP = 0.002
"""s"""


def fake_case(name: str = "fake", worlds: int = 3, **options: object) -> Case:
    return Case(name, FAKE.name, worlds, vehicles=2, dtype="float64", tick="scans", options=options)


def build(case: Case) -> Built:
    print("libraries print whatever they like on standard output")
    if "import_error" in case.options:
        raise ImportError("no module\nof that name")
    if "tell" in case.options:
        raise ValueError(f"{case.options['tell']} is {os.environ[case.options['tell']]}")
    steps_left = case.options.get("steps_left", 1 << 30)
    ballast = bytearray(case.options.get("bytes", 0))
    ballast[::4096] = b"x" * len(ballast[::4096])

    def step() -> int:
        nonlocal steps_left
        steps_left -= 1
        if steps_left < 0:
            os._exit(7)
        time.sleep(STEP + 0 * len(ballast))
        return 5 * case.worlds

    return Built(step, array_bytes=len(ballast) or None)
