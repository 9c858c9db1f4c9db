"""A router and all the fake cars of a deployment, as processes of their own for as long as they are needed."""

import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from coopenv.errors import CoopenvError
from coopenv.interrupts import before_a_hard_end, held
from coopenv.svea.deployment import load_deployment

READY = 300.0
"""s that fakes have until they can be seen: the first ones on a computer compile the simulation's kernels."""
GRACE = 0.5  # s that processes have to end by themselves
POLL = 0.02  # s
LOOPBACK = "127.0.0.1"

_running: list["Process"] = []


class FakesError(CoopenvError):
    """The router or a fake car does not run."""


class Process:
    """A command of coopenv, which leads a process group of its own."""

    def __init__(self, name: str, command: Sequence[str], folder: Path) -> None:
        """Start it.

        Args:
            name: in errors.
            command: arguments of `coopenv`.
            folder: where what it prints is kept.
        """
        self.name = name
        self._said = folder / f"{name}.out", folder / f"{name}.err"
        with held(), self._said[0].open("w") as out, self._said[1].open("w") as errors:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "coopenv", *command],
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=errors,
                start_new_session=True,  # Ctrl-C is for who started it: cars are brought to a stand first
            )
            _running.append(self)

    def wait_until_ready(self, until: float) -> None:
        """Wait for the line that says so, at most until a time of the monotonic clock.

        Raises:
            FakesError: it has ended, or the time is over; the line quotes its last error.
        """
        while "ready" not in self._said[0].read_text(encoding="utf-8", errors="replace"):
            status = self._process.poll()
            if status is not None:
                raise FakesError(f"{self.name} has ended with status {status}: {self._last_words()}")
            if time.monotonic() > until:
                raise FakesError(f"{self.name} is not ready in time: {self._last_words()}")
            time.sleep(POLL)

    def _last_words(self) -> str:
        lines = self._said[1].read_text(encoding="utf-8", errors="replace").split("\n")
        return next((line.removeprefix("error: ") for line in reversed(lines) if line.strip()), "it has said nothing")

    def send(self, number: int) -> None:
        """Send a signal to the process and to all that it has started."""
        if self._process.poll() is None or number == signal.SIGKILL:
            with suppress(ProcessLookupError, PermissionError):
                os.killpg(self._process.pid, number)

    def end(self, until: float) -> None:
        """Wait for it to end, at most until a time of the monotonic clock; then it is ended by force."""
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(max(until - time.monotonic(), 0.0))
        self.send(signal.SIGKILL)
        self._process.wait()
        _running.remove(self)


@contextmanager
def fakes(deployment: str | Path, port: int | None = None, seed: int = 0, patience: float = READY) -> Iterator[str]:
    """Run a router on this computer and a fake of every car; yield the router's endpoint, and end them all afterwards.

        with fakes("overtaking.toml") as router:
            env = coopenv.parallel_env(
                "svea_overtaking", backend="svea", deployment="overtaking.toml", connect=router
            )

    Args:
        deployment: file of the fleet; its `network.connect` does not count here.
        port: of the router (None: one that is free).
        seed: of the fakes, see `coopenv.fake.car.Fake`.
        patience: s to wait for them.

    Raises:
        FakesError: one of them does not start; the line quotes its error.
        CoopenvError: the file is not valid, or its cars are not fakes.
    """
    endpoint = f"tcp/{LOOPBACK}:{free_port() if port is None else port}"
    fleet = load_deployment(deployment, endpoint)
    if not fleet.fakes:
        raise FakesError(f"{deployment}: fakes = true is missing, these are real cars")
    given = ("--connect", endpoint, "--seed", str(seed))
    started: list[Process] = []
    until = time.monotonic() + patience
    with tempfile.TemporaryDirectory(prefix="coopenv-fakes-") as place:
        try:
            started.append(Process("router", ("svea", "router", "--listen", endpoint), Path(place)))
            started[0].wait_until_ready(until)
            for car in fleet.cars:
                command = ("svea", "fake", str(deployment), "--car", car.name, *given)
                started.append(Process(car.name, command, Path(place)))
            for process in started[1:]:
                process.wait_until_ready(until)
            yield endpoint
        finally:
            _end(started)


def _end(started: list[Process]) -> None:
    """End processes, the router last: the cars' gates take their leave."""
    for some in (started[1:], started[:1]):
        for process in some:
            process.send(signal.SIGTERM)
        until = time.monotonic() + GRACE
        for process in some:
            process.end(until)


def free_port() -> int:
    """Return a port of this computer that nobody listens at."""
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return int(probe.getsockname()[1])


def _kill_all() -> None:
    for process in list(_running):
        process.send(signal.SIGKILL)


before_a_hard_end(_kill_all)
