"""One process of a measurement: builds cases of one library, and steps them when told to.

`python -m coopenv.bench.worker MODULE:FUNCTION`, where FUNCTION makes a `Built` of a `Case`. Each line of standard
input is a request in JSON, each line of standard output its reply:

    {"do": "build", "case": {...}}             -> {"id", "build_s", "first_step_s", "rss_bytes", "array_bytes"}
    {"do": "run", "id": 0, "seconds": 0.5}     -> {"steps", "ticks", "wall_s", "cpu_s"}

A request that fails is answered by {"error": "one line"}. The process ends with its input.
"""

from __future__ import annotations

import gc
import json
import os
import signal
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, TextIO

from coopenv.bench.cases import Case

WARM_UP = 0.1
"""s of stepping before anything counts."""


@dataclass(frozen=True)
class Built:
    """A case ready to be measured."""

    step: Callable[[], int]
    """Advances all worlds by one environment step, restarts what is over, returns the vehicle ticks that it did."""
    array_bytes: int | None = None
    """Of all worlds' arrays, if known."""


class Server:
    """Answers requests."""

    def __init__(self, build: Callable[[Case], Built]) -> None:
        self._build = build
        self._steps: list[Callable[[], int]] = []

    def answer(self, request: dict[str, Any]) -> dict[str, Any]:
        """Return the reply to a request; every failure is a reply too."""
        try:
            if request["do"] == "build":
                return self._built(Case(**request["case"]))
            return timed(self._steps[request["id"]], request["seconds"])
        except Exception as error:
            return {"error": " ".join(f"{type(error).__name__}: {error}".split())}

    def _built(self, case: Case) -> dict[str, Any]:
        if not self._steps:  # what the library itself occupies is no case's memory
            self._build(case).step()
        gc.collect()
        memory, start = resident_bytes(), time.perf_counter()
        built = self._build(case)
        ready = time.perf_counter()
        built.step()
        first = time.perf_counter()
        timed(built.step, WARM_UP)
        gc.collect()
        grown = None if memory is None else (resident_bytes() or 0) - memory
        self._steps.append(built.step)
        return {
            "id": len(self._steps) - 1,
            "build_s": ready - start,
            "first_step_s": first - ready,
            "rss_bytes": grown,
            "array_bytes": built.array_bytes,
        }


def timed(step: Callable[[], int], seconds: float) -> dict[str, Any]:
    """Step for `seconds`, at least once, and return what was done in which time."""
    steps = ticks = 0
    cpu = time.process_time()
    now = start = time.perf_counter()
    while now - start < seconds or steps == 0:
        ticks += step()
        steps += 1
        now = time.perf_counter()
    return {"steps": steps, "ticks": ticks, "wall_s": now - start, "cpu_s": time.process_time() - cpu}


def resident_bytes() -> int | None:
    """Return the memory that this process holds, where the system tells."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except (OSError, ValueError, IndexError):
        return None
    return pages * os.sysconf("SC_PAGE_SIZE")


def serve(build: Callable[[Case], Built], requests: TextIO, replies: TextIO) -> None:
    """Answer requests until there are no more."""
    server = Server(build)
    for line in requests:
        print(json.dumps(server.answer(json.loads(line))), file=replies, flush=True)


def main(target: str) -> None:
    """Serve standard input; what libraries print goes to standard error, and Ctrl-C is the parent's business."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    replies = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    warnings.simplefilter("ignore")
    module, _, function = target.partition(":")
    serve(getattr(import_module(module), function), sys.stdin, replies)


if __name__ == "__main__":
    main(sys.argv[1])
