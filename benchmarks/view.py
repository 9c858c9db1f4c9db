"""Cost of the live view: the share of a core of the process that simulates, draws and serves.

`python -m benchmarks.view [ENV ...]` prints it without anybody who watches, and with one who reads everything: at the
frames a second that the environment gives, and at 20, of which that without the simulation is what watching adds.
"""

import argparse
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from time import monotonic, process_time, thread_time
from typing import NamedTuple

from benchmarks.options import status_of
from coopenv.base.errors import CoopenvError
from coopenv.observers.registry import with_observer
from coopenv.runs.live import EngineReel
from coopenv.runs.scenes import driver_of
from coopenv.runs.view import Viewer
from coopenv.sources.sources import open_backend
from coopenv.viz.web import guarded_server

WARM_UP = 2.0  # s
RATE = 20.0  # frames/s, to which shares are scaled


class Measured(NamedTuple):
    """Measurements in a second: frames, and CPU time, s, of the whole process and of the simulation in it."""

    frames: float
    cpu: float
    simulation: float


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print a line per environment; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("environments", nargs="*", default=["busy_intersection", "urban_crossing", "large_crossing"])
    parser.add_argument("--observer", default=None)
    parser.add_argument("--seconds", type=float, default=15.0)
    asked = parser.parse_args(arguments)
    return status_of(measure, asked)


def measure(asked: argparse.Namespace) -> None:
    """Print the table."""
    print(f"{'':20} {'':8} {'':>9} {'of a core':>10} {'the same':>10} {'without the':>12}")
    print(f"{'environment':20} {'watched':8} {'frames/s':>9} {'':>10} {f'at {RATE:g}/s':>10} {'simulation':>12}")
    for name in asked.environments:
        for watched in (False, True):
            frames, cpu, simulation = measured(name, asked.observer, asked.seconds, watched)
            if frames == 0.0:
                raise CoopenvError(f"--seconds {asked.seconds:g}: nothing was shown in that time, give more")
            scaled = [100 * cpu, 100 * cpu * RATE / frames, 100 * (cpu - simulation) * RATE / frames]
            shares = " ".join(f"{share:{width}.1f}%" for share, width in zip(scaled, (9, 9, 11), strict=True))
            print(f"{name:20} {'yes' if watched else 'no':8} {frames:9.1f} {shares}", flush=True)


class TimedReel(EngineReel):
    """A reel that knows how long the simulation of its frames took."""

    simulated = 0.0
    """CPU time, s."""

    def more(self) -> bool:
        """Run on to the next frame."""
        begin = thread_time()
        try:
            return super().more()
        finally:
            self.simulated += thread_time() - begin


def measured(name: str, observer: str | None, seconds: float, watched: bool) -> Measured:
    """Show an environment for some seconds."""
    opened = lambda more: open_backend(name, None, with_observer(more, observer))  # noqa: E731
    reel = TimedReel(opened, name, 0, lambda scenario: driver_of(None, scenario, name, 0))
    try:
        with guarded_server("127.0.0.1") as (server, url):
            viewer = Viewer(server, reel)
            with somebody(url) if watched else nobody():
                viewer.run(until(WARM_UP))
                before, begin = (viewer.shown, process_time(), reel.simulated), monotonic()
                viewer.run(until(seconds))
                after, elapsed = (viewer.shown, process_time(), reel.simulated), monotonic() - begin
                return Measured(*((b - a) / elapsed for a, b in zip(before, after, strict=True)))
    finally:
        reel.close()


def until(seconds: float) -> Callable[[], bool]:
    """Return what says for so long that it goes on."""
    end = monotonic() + seconds
    return lambda: monotonic() < end


@contextmanager
def nobody() -> Iterator[None]:
    """Let nobody watch."""
    yield


@contextmanager
def somebody(url: str) -> Iterator[None]:
    """Let a program in a process of its own read all that is sent, as a browser does."""
    import subprocess

    code = (
        "import sys, viser\nfrom websockets.sync.client import connect\n"
        "with connect(sys.argv[1], subprotocols=['viser-v' + viser.__version__], max_size=None) as link:\n"
        "    print('there', flush=True)\n    for message in link: pass\n"
    )
    address = url.replace("http", "ws")
    reader = subprocess.Popen([sys.executable, "-c", code, address], stdout=subprocess.PIPE, text=True)
    try:
        assert reader.stdout is not None
        reader.stdout.readline()
        yield
    finally:
        reader.terminate()
        reader.wait()


if __name__ == "__main__":
    sys.exit(main())
