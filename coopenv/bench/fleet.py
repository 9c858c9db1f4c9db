"""The worker processes of a measurement, seen from the command: one per library, one busy at a time."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import asdict
from types import TracebackType
from typing import Any

from coopenv.bench.cases import Case, Library

ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")


class WorkerError(RuntimeError):
    """A case cannot be built or stepped; one line."""


def worker_environment() -> dict[str, str]:
    """Return variables under which libraries keep to one thread, open no window and are found as they are here."""
    return {
        **os.environ,
        **dict.fromkeys(ONE_THREAD, "1"),
        "SDL_VIDEODRIVER": "dummy",
        "PYGAME_HIDE_SUPPORT_PROMPT": "1",
        "MPLBACKEND": "Agg",
        "PYTHONPATH": os.pathsep.join(path for path in sys.path if path),
    }


class Worker:
    """One process of `coopenv.bench.worker`."""

    def __init__(self, build: str) -> None:
        """Start it for a builder, module:function."""
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "coopenv.bench.worker", build],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=worker_environment(),
            text=True,
        )

    def ask(self, **request: Any) -> dict[str, Any]:
        """Return the reply to a request.

        Raises:
            WorkerError: the request failed, or the process has ended.
        """
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        try:
            print(json.dumps(request), file=self._process.stdin, flush=True)
            line = self._process.stdout.readline()
        except BrokenPipeError:
            line = ""
        if not line:
            raise WorkerError(f"its process ended with status {self._process.wait()}")
        reply: dict[str, Any] = json.loads(line)
        if "error" in reply:
            raise WorkerError(reply["error"])
        return reply

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.communicate()


class Fleet:
    """Builds and runs cases, each in the process of its library."""

    def __init__(self, libraries: list[Library]) -> None:
        """Start nothing yet."""
        self._libraries = {library.name: library for library in libraries}
        self._workers: dict[str, Worker] = {}

    def build(self, case: Case) -> dict[str, Any]:
        """Build a case and return the worker's reply, with the id to run it by."""
        return self._worker(case).ask(do="build", case=asdict(case))

    def run(self, case: Case, identity: int, seconds: float) -> dict[str, Any]:
        """Step a built case for some time."""
        return self._worker(case).ask(do="run", id=identity, seconds=seconds)

    def _worker(self, case: Case) -> Worker:
        if case.library not in self._workers:
            self._workers[case.library] = Worker(self._libraries[case.library].build)
        return self._workers[case.library]

    def __enter__(self) -> Fleet:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for worker in self._workers.values():
            worker.close()
