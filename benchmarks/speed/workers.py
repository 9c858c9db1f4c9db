"""A process of its own per library, in which its cases are built and stepped; one is busy at a time."""

from __future__ import annotations

import gc
import multiprocessing
import os
import time
import warnings
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from importlib import import_module
from pathlib import Path
from types import TracebackType
from typing import Any

from benchmarks.speed.cases import Case, Library
from coopenv.base.installation import ONE_THREAD, environment

VARIABLES = {**ONE_THREAD, "SDL_VIDEODRIVER": "dummy", "PYGAME_HIDE_SUPPORT_PROMPT": "1", "MPLBACKEND": "Agg"}
"""Environment variables under which libraries keep to one thread and open no window."""
WARM_UP = 0.1
"""s of stepping before anything counts."""


class WorkerError(RuntimeError):
    """A case cannot be built or stepped; one line."""


class Workers:
    """The processes of some libraries, each started when it is first needed."""

    def __init__(self, libraries: list[Library]) -> None:
        """Start nothing yet."""
        self._libraries = {library.name: library for library in libraries}
        self._pools: dict[str, ProcessPoolExecutor] = {}

    def build(self, case: Case) -> dict[str, Any]:
        """Build a case.

        Returns:
            `id` to run it by, `build_s`, `first_step_s`, `rss_bytes` (None where the system does not tell) and
            `array_bytes`.

        Raises:
            WorkerError: it cannot be built, or the process has ended.
        """
        return self._ask(case, _build, self._libraries[case.library].build, case)

    def run(self, case: Case, identity: int, seconds: float) -> dict[str, Any]:
        """Step a built case for some time.

        Returns:
            `steps` of the whole batch, vehicle `ticks`, `wall_s` and `cpu_s`.

        Raises:
            WorkerError: a step failed, or the process has ended.
        """
        return self._ask(case, _run, identity, seconds)

    def _ask(self, case: Case, function: Callable[..., dict[str, Any]], *arguments: Any) -> dict[str, Any]:
        try:
            return self._pool(case.library).submit(function, *arguments).result()
        except BrokenProcessPool:
            raise WorkerError("its process ended") from None
        except Exception as error:  # any library's
            raise WorkerError(" ".join(f"{type(error).__name__}: {error}".split())) from None

    def _pool(self, library: str) -> ProcessPoolExecutor:
        if library not in self._pools:
            pool = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), _silence)
            self._pools[library] = pool
            with environment(VARIABLES):
                pool.submit(os.getpid).result()  # starts the process
        return self._pools[library]

    def __enter__(self) -> Workers:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for pool in self._pools.values():
            pool.shutdown(wait=error is None, cancel_futures=True)


_steps: list[Callable[[], int]] = []
"""The cases that were built in this process."""


def _silence() -> None:
    """Send what libraries print nowhere; runs in a worker process, like all that follows."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
    warnings.simplefilter("ignore")


def _build(builder: str, case: Case) -> dict[str, Any]:
    module, _, function = builder.partition(":")
    build = getattr(import_module(module), function)
    if not _steps:  # what the library itself occupies is no case's memory
        build(case).step()
    gc.collect()
    memory, start = resident_bytes(), time.perf_counter()
    built = build(case)
    ready = time.perf_counter()
    built.step()
    first = time.perf_counter()
    timed(built.step, WARM_UP)
    gc.collect()
    _steps.append(built.step)
    return {
        "id": len(_steps) - 1,
        "build_s": ready - start,
        "first_step_s": first - ready,
        "rss_bytes": None if memory is None else (resident_bytes() or 0) - memory,
        "array_bytes": built.array_bytes,
    }


def _run(identity: int, seconds: float) -> dict[str, Any]:
    return timed(_steps[identity], seconds)


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
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    except (OSError, ValueError, IndexError):
        return None
    return pages * os.sysconf("SC_PAGE_SIZE")
