"""Scenes of episodes, kept while they run or read from the files of a run; the pages and logs made of them."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import replace
from importlib.util import find_spec
from math import ceil
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from coopenv.api.engine import Engine
from coopenv.base.errors import CoopenvError
from coopenv.base.installation import install_command, list_envs
from coopenv.episode import SCENE_FILE, Episode, Origin, Views
from coopenv.evaluation.episodes import play
from coopenv.observers.recording import Recording
from coopenv.observers.registry import named, observer_of_robots, with_observer
from coopenv.policies import Policy, agents_for, find_agent, load_policy
from coopenv.runs.console import Progress, compile_notice
from coopenv.runs.recorder import record_episode, source_of
from coopenv.scenario import Scenario
from coopenv.sources.base import Backend
from coopenv.sources.mcap import log_views, write_recording
from coopenv.sources.registry import kind_of
from coopenv.sources.worlds import Replay

BASELINE = "route_follower"
LOOKING = ("look_ahead", "peek")
"""Drivers that keep landmarks in view."""
MOST_SHOWN = 120.0  # s of a recording on its page, whose frames would be too far apart otherwise
MAX_FPS = 20.0


def frame_stride(scenario: Scenario) -> int:
    """Return the camera ticks between pictures: one per decision, but at most `MAX_FPS` a second."""
    return scenario.ticks_per_decision * max(1, ceil(scenario.rates.decision / MAX_FPS - 1e-9))


def scene_of(
    engine: Engine,
    source: Origin,
    policy: Policy | None = None,
    on_progress: Callable[[float], None] = lambda share: None,
    longest: float = np.inf,
) -> Episode:
    """Play an episode in the first world of an engine and return its scene.

    Args:
        engine: any.
        source: source of the scene; its seed is the episode's.
        policy: drives (None: action zero).
        on_progress: called with the share that is done.
        longest: length, s, after which the episode is broken off.

    Raises:
        CoopenvError: the policy fails, or the backend cannot begin.
    """
    views, scenario = Views(engine), engine.backend.scenario
    ticks, stride = int(min(scenario.horizon_ticks, longest * scenario.rates.camera)), frame_stride(scenario)
    tick = 0
    for tick in play(engine, [source.seed or 0], ticks, policy, to_the_end=False):
        if tick % stride == 0:
            views.take()
            on_progress(tick / ticks)
    if tick % stride:
        views.take()
    return views.episode(scenario, source)


def played_scene(
    backend: Backend,
    name: str,
    log: Console,
    seed: int | None = None,
    policy: Policy | None = None,
    driver: str = "",
    longest: float = np.inf,
) -> Episode:
    """Play an episode of a backend with progress shown and return its scene; arguments as for `scene_of`.

    `name` and `driver` stand in its heading.
    """
    with closing(Engine(backend.scenario, backend=backend)) as engine:
        with compile_notice(log):
            engine.load()
        with Progress(log, "replaying" if backend.capabilities.recorded else "running", 1.0) as progress:
            return scene_of(engine, source_of(engine, name, seed, driver), policy, progress.update, longest)


def saved_scene(name: str | Path) -> Episode | None:
    """Return the scene in the folder of a run, or of a file `*.npz`; None: the name means something else.

    Raises:
        CoopenvError: the folder is of a run that has kept none, or the file is no scene.
    """
    path = Path(name)
    if str(name) in list_envs():
        return None  # a folder that is called like an environment is ./NAME
    if path.suffix == ".npz":
        return Episode.load(path)
    if (path / SCENE_FILE).is_file():
        return Episode.load(path / SCENE_FILE)
    if any((path / kept).is_file() for kept in ("trajectory.npz", "metrics.json")):
        raise CoopenvError(f"{path}: has no {SCENE_FILE}, which `coopenv run` writes since 0.2; run it again")
    return None


def driver_of(
    name: str | None, scenario: Scenario, environment: str, seed: int, preferred: tuple[str, ...] = ()
) -> tuple[Policy | None, str]:
    """Return the driver and its name: the given one, else the baseline if it can drive, else none.

    The first of the `preferred` agents that was made for the environment comes before the baseline.

    Raises:
        CoopenvError: there is no such agent, or it cannot drive here.
    """
    if not scenario.driven:
        return None, ""
    made = agents_for(Path(environment).stem)
    name = name or next((agent for agent in preferred if agent in made), None)
    if name is None:
        name = BASELINE
        if BASELINE not in made:
            try:
                find_agent(BASELINE).policy(scenario)
            except CoopenvError:
                name = "zero"
    return load_policy(name, scenario, seed), Path(name).name


def title_of(name: str) -> str:
    """Return the name of a source in headings."""
    path = Path(name)
    return path.name if kind_of(name).recorded else path.stem


def write_page(record: Episode, path: Path, log: Console, others: Mapping[str, str] | None = None) -> Path | None:
    """Write the page that plays a scene, with progress shown; None, and a line, where the extra `view` is missing.

    `others` are the pages of all drivers by their names, to which this one leads.
    """
    if not pages_can_be_written(path, log):
        return None
    from coopenv.viz.web import write_replay

    with Progress(log, f"writing {path.name}", total=1.0) as progress:
        return write_replay(record, path, progress.update, others)


def pages_can_be_written(path: Path, log: Console) -> bool:
    """Return whether the extra `view` is installed; where it is not, a line says so."""
    there = find_spec("viser") is not None
    if not there:
        log.print(
            f"note: no {path.name}: pages in the browser need an extra: {install_command('view')}", soft_wrap=True
        )
    return there


def observer_of(recording: Recording) -> str:
    """Return the name of the observer of a recording where none is asked for."""
    return observer_of_robots() if recording.scenario is None else recording.scenario.observer.name


def write_log(recording: Recording, path: Path, log: Console, observer: str | None = None, scene: bool = True) -> None:
    """Write a recording to a file; with a scene, also the views of other programs, with an observer's estimates.

    Stamps are those of the wall clock: tick 0 is now.

    Args:
        recording: the recording to read back.
        path: of the file.
        log: console of the progress.
        observer: name, or where its class stands; None: that of the scenario.
        scene: also write data for viewers beyond the recording.

    Raises:
        CoopenvError: no such observer, or it fails on the recording, or the file cannot be written.
    """
    start = time.time()
    shown: list[Any] = []
    if scene:
        name = named(observer or observer_of(recording))
        with Progress(log, f"estimating with {name}"):
            try:
                played = record_episode(Replay(recording, path.name, with_observer({}, name)))
            except CoopenvError as error:
                raise CoopenvError(f"{error}; --no-scene writes the recording alone") from None
        episode = replace(played, recording=recording)
        for program in log_views().values():
            shown += program.views(episode, start=start)
    with Progress(log, f"writing {path.name}"):
        write_recording(recording, path, views=shown, start=start)
