"""Runs numbered cases in a process of their own, so that a crash or hang is a failure of one case and no more.

A module of cases has a function `case(number)` that returns how the input was taken ("accepted", "refused", ...) and
raises when anything is wrong, and may have `prepare()`. `python -m tests.fuzz.harness MODULE FIRST LAST` runs some.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
import traceback
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib import import_module
from queue import Empty, Queue
from threading import Thread

HANG_S = 10.0
"""Without a word from a case."""
START_S = 900.0
"""Without a word from the preparation: kernels may have to be compiled."""


@dataclass
class Outcome:
    """What came of some cases."""

    taken: Counter[str] = field(default_factory=Counter)
    """How often which word was returned."""
    failures: dict[int, str] = field(default_factory=dict)
    """Case to what went wrong."""
    longest_s: float = 0.0
    """Of one case that came to an end."""


class Child:
    """A process that runs cases and says a line about each."""

    def __init__(self, module: str, first: int, last: int) -> None:
        command = [sys.executable, "-m", __name__, module, str(first), str(last)]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        self.lines: Queue[str] = Queue()
        Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.lines.put(line.rstrip("\n"))
        self.lines.put("")

    def line(self, timeout_s: float) -> str:
        """Return the next line; `!` and what happened instead of one."""
        try:
            line = self.lines.get(timeout=timeout_s)
        except Empty:
            return "!hangs"
        return line or f"!ended the process ({self.process.wait()})"

    def end(self) -> str:
        """End the process and return what it said on standard error."""
        self.process.kill()
        assert self.process.stderr is not None
        with self.process.stderr as stream:
            return stream.read()


def run_cases(module: str, numbers: Sequence[int], hang_s: float | None = None) -> Outcome:
    """Run cases first..last of a module, beginning anew after each one that takes the process along."""
    patience = HANG_S if hang_s is None else hang_s
    outcome, number, last = Outcome(), numbers[0], numbers[-1]
    while number <= last:
        child = Child(module, number, last)
        ready = child.line(START_S)
        alive = ready == "ready"
        while alive and number <= last:
            begin = time.monotonic()
            line = child.line(patience)
            if line.startswith("!"):
                outcome.failures[number] = line[1:].replace("\\n", "\n")
                alive = line.startswith("!Traceback")
            else:
                outcome.taken[line] += 1
                outcome.longest_s = max(outcome.longest_s, time.monotonic() - begin)
            number += 1
        said = child.end()
        assert ready == "ready", f"{ready}\n{said}"
    return outcome


def main(module: str, first: str, last: str) -> None:
    """Run cases, a line each: how it was taken, or `!` and a traceback."""
    out = os.fdopen(os.dup(1), "w", buffering=1)
    cases = import_module(module)
    getattr(cases, "prepare", lambda: None)()
    out.write("ready\n")
    for number in range(int(first), int(last) + 1):
        try:
            word = cases.case(number)
        except Exception:
            word = "!" + traceback.format_exc(limit=-6).replace("\n", "\\n")
        out.write(word + "\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
