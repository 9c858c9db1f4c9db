"""What the live view costs: the share of a core of the process that simulates, draws and serves, at 20 frames a second.

`python -m benchmarks.view [ENV ...]` prints it without anybody who watches, and with one who reads everything.
"""

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from time import monotonic, process_time

from coopenv.runs.scenes import driver_of, open_source
from coopenv.runs.view.reels import EngineReel
from coopenv.runs.view.serving import serving
from coopenv.runs.view.viewer import Viewer

WARM_UP = 2.0  # s


def main() -> None:
    """Measure and print a line per environment."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("environments", nargs="*", default=["busy_intersection", "urban_crossing", "large_crossing"])
    parser.add_argument("--observer", default=None)
    parser.add_argument("--seconds", type=float, default=15.0)
    asked = parser.parse_args()
    print(f"{'environment':20} {'watched':8} {'frames/s':>9} {'of a core':>10}")
    for name in asked.environments:
        for watched in (False, True):
            rate, share = measured(name, asked.observer, asked.seconds, watched)
            print(f"{name:20} {'yes' if watched else 'no':8} {rate:9.1f} {100 * share:9.1f}%", flush=True)


def measured(name: str, observer: str | None, seconds: float, watched: bool) -> tuple[float, float]:
    """Return frames a second and the share of a core."""
    opened = partial(open_source, name, observer=observer)
    reel = EngineReel(opened, name, 0, lambda scenario: driver_of(None, scenario, name, 0))
    try:
        with serving("127.0.0.1", None) as (server, url):
            viewer = Viewer(server, reel)
            with somebody(url) if watched else nobody():
                viewer.run(until(WARM_UP))
                frames, cpu, begin = viewer.shown, process_time(), monotonic()
                viewer.run(until(seconds))
                elapsed = monotonic() - begin
                return (viewer.shown - frames) / elapsed, (process_time() - cpu) / elapsed
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
    import sys

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
    main()
