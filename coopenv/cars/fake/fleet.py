"""A router and all the fake cars of a deployment, as processes of their own for as long as they are needed."""

import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path

from coopenv.base.errors import CoopenvError
from coopenv.base.interrupts import WITH_INPUT, before_a_hard_end, held
from coopenv.cars.backend.backend import scenario_of
from coopenv.cars.backend.binding import bind
from coopenv.cars.fake.car import Fake
from coopenv.cars.gate.process import prepare_gate
from coopenv.cars.settings.deployment import Deployment, load_deployment

READY = 300.0
"""Longest start of fakes, s: the first ones on a computer compile the simulation's kernels."""
GRACE = 0.5  # s that processes have to end by themselves
POLL = 0.02  # s
LOOPBACK = "127.0.0.1"

_running: list["Process"] = []


class FakesError(CoopenvError):
    """The router or a fake car does not run."""


class Process(subprocess.Popen[bytes]):
    """A command of coopenv, which leads a process group of its own."""

    def __init__(self, name: str, command: Sequence[str], folder: Path) -> None:
        """Start it.

        Args:
            name: in errors.
            command: arguments of `coopenv`.
            folder: of its output.
        """
        self.name = name
        self._logs = folder / f"{name}.out", folder / f"{name}.err"
        with held(), self._logs[0].open("w") as out, self._logs[1].open("w") as errors:
            super().__init__(
                [sys.executable, "-m", "coopenv", *command],
                stdin=subprocess.PIPE,  # which is closed when this process ends, also by force
                env={**os.environ, WITH_INPUT: "1"},
                stdout=out,
                stderr=errors,
                start_new_session=True,  # Ctrl-C is for who started it: cars are brought to a stand first
            )
            _running.append(self)

    def wait_until_ready(self, until: float) -> None:
        """Wait for its line `ready`, at most until a time of the monotonic clock.

        Raises:
            FakesError: it has ended, or the time is over; the line quotes its last error.
        """
        while "ready" not in self._logs[0].read_text(encoding="utf-8", errors="replace"):
            if self.poll() is not None:
                raise FakesError(f"{self.name} has ended with status {self.returncode}: {self._last_error()}")
            if time.monotonic() > until:
                raise FakesError(f"{self.name} is not ready in time: {self._last_error()}")
            time.sleep(POLL)

    def _last_error(self) -> str:
        lines = self._logs[1].read_text(encoding="utf-8", errors="replace").split("\n")
        return next(
            (line.removeprefix("error: ") for line in reversed(lines) if line.strip()), "it has printed nothing"
        )

    def send_signal(self, number: int) -> None:
        """Send a signal to the process and to all that it has started."""
        if self.poll() is None or number == signal.SIGKILL:
            with suppress(ProcessLookupError, PermissionError):
                os.killpg(self.pid, number)

    def end(self, until: float) -> None:
        """Wait for it to end, at most until a time of the monotonic clock; then it is ended by force."""
        with suppress(subprocess.TimeoutExpired):
            self.wait(max(until - time.monotonic(), 0.0))
        self.kill()
        self.wait()
        assert self.stdin is not None
        self.stdin.close()
        _running.remove(self)


def fleet_of_fakes(path: str | Path, connect: str | None = None) -> Deployment:
    """Return a deployment, as `load_deployment` does. Raises FakesError: its cars are real ones."""
    fleet = load_deployment(path, connect)
    if not fleet.fakes:
        raise FakesError(f"{path}: fakes = true is missing, these are real cars")
    return fleet


@contextmanager
def fakes(deployment: str | Path, port: int | None = None, seed: int = 0, patience: float = READY) -> Iterator[str]:
    """Run a router on this computer and fakes of all cars; yield the router's endpoint, and end them all afterwards.

        with fakes("overtaking.toml") as router:
            env = coopenv.parallel_env(
                "svea_overtaking", backend="svea", deployment="overtaking.toml", connect=router
            )

    Args:
        deployment: file of the fleet; its `network.connect` does not count here.
        port: of the router (None: one that is free).
        seed: of the fakes, see `coopenv.cars.fake.car.Fake`.
        patience: s to wait for them.

    Raises:
        FakesError: one of them does not start; the line quotes its error.
        CoopenvError: the file is not valid, or its cars are not fakes.
    """
    endpoint = f"tcp/{LOOPBACK}:{free_port() if port is None else port}"
    fleet = fleet_of_fakes(deployment, endpoint)
    started: list[Process] = []
    until = time.monotonic() + patience
    with tempfile.TemporaryDirectory(prefix="coopenv-fakes-") as place:
        try:
            started.append(Process("router", ("svea", "router", "--listen", endpoint), Path(place)))
            started[0].wait_until_ready(until)
            for car in fleet.cars:
                own = (str(deployment), "--car", car.name, "--connect", endpoint)
                started.append(Process(car.name, ("svea", "fake", *own, "--seed", str(seed)), Path(place)))
                if fleet.profile.sees_frames and car.landmark is None:
                    command = ("svea", "see", *own, "--patience", str(patience))
                    started.append(Process(f"see of {car.name}", command, Path(place)))
            for process in started[1:]:
                process.wait_until_ready(until)
            yield endpoint
        finally:
            for some in (started[1:], started[:1]):  # the router last: the cars' gates take their leave
                for process in some:
                    process.terminate()
                until = time.monotonic() + GRACE
                for process in some:
                    process.end(until)


def free_port() -> int:
    """Return a free port of this computer."""
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return int(probe.getsockname()[1])


def _kill_all() -> None:
    for process in list(_running):
        process.kill()


before_a_hard_end(_kill_all)

REST = 0.004
"""Least time (s) between two checks of the clock: events due in between run together."""


def prepare_fake(path: str | Path, car: str, gate: bool = True, station: str | None = None) -> Callable[..., Fake]:
    """Return the constructor of a fake from a network and further arguments of `Fake`, checked as far as possible.

    Args:
        path: deployment file.
        car: its name.
        gate: use a gate for commands; otherwise the fake obeys ManualControl.
        station: whose commands count at its gate (None: those of the file's `security.identity`).

    Raises:
        CoopenvError: the file or its environment is not valid, the car is unknown, or a key is missing or another's.
    """
    fleet = load_deployment(path)
    fleet.car(car)
    scenario = scenario_of(fleet, None, {})
    if scenario.backend != "simulated":
        raise CoopenvError(f"{path}: environment: backend '{scenario.backend}' has no fakes; known: simulated")
    binding = bind(scenario, fleet.cars, fleet.markers, Path(path).name, None, fleet.profile)
    own_gate = prepare_gate(fleet, car, station) if gate else None
    return partial(
        Fake, binding, car, differential=fleet.sensors.odometry == "wheel", gate=own_gate, settings=fleet.fake
    )


def run(fake: Fake, stop: threading.Event) -> None:
    """Run a car in real time until `stop` is set, or an exception such as a signal's ends it."""
    try:
        while not stop.is_set():
            fake.advance()
            stop.wait(max((fake.next - time.monotonic_ns()) * 1e-9, REST))
    finally:
        fake.close()
