"""Write a recording with what viewers show of it."""

from __future__ import annotations

import time
from pathlib import Path

from rich.console import Console

from coopenv.backends.mcap import write_recording
from coopenv.base.errors import CoopenvError
from coopenv.observers import run
from coopenv.observers.recording import Recording
from coopenv.observers.registry import find, named, states_covariance
from coopenv.runs.console import Progress
from coopenv.viz.foxglove.views import check_installed, views

_ON_A_PLANE = "planar_robust"
"""Observer of recorded robots unless another one is asked for."""


def check_scene(observer: str | None) -> None:
    """Refuse before any work what `write_log` would refuse. Raises CoopenvError: no such observer, or no SDK."""
    check_installed()
    if observer is not None:
        find(named(observer))


def observer_of(recording: Recording) -> str:
    """Return the name of the observer of a recording where none is asked for."""
    return _ON_A_PLANE if recording.scenario is None else recording.scenario.observer.name


def write_log(recording: Recording, path: Path, log: Console, observer: str | None = None, scene: bool = True) -> None:
    """Write a recording to a file; with a scene, what Foxglove shows of it and of an observer's estimates.

    Stamps are those of the wall clock: tick 0 is now.

    Args:
        recording: what is read back.
        path: of the file.
        log: where progress is shown.
        observer: name, or where its class stands; None: that of the scenario.
        scene: whether there is anything for viewers but what the recording has.

    Raises:
        CoopenvError: no such observer, or it fails on the recording, or the file cannot be written.
    """
    start = time.time()
    shown = []
    if scene:
        name = named(observer or observer_of(recording))
        with Progress(log, f"estimating with {name}"):
            result = run(name, recording)
        if result.failure:
            raise CoopenvError(f"observer {name} failed: {result.failure}; --no-scene writes the recording alone")
        shown = views(recording, result, start=start, gain=not states_covariance(name))
    with Progress(log, f"writing {path.name}"):
        write_recording(recording, path, views=shown, start=start)
