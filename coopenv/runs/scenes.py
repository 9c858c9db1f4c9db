"""Scenes of episodes: kept while they run, or read from what a run has left; and the pages that play them."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from coopenv.api.engine import Engine
from coopenv.backends.base import Backend
from coopenv.backends.mcap import write_recording
from coopenv.backends.sources import SourceKind, kind_of, open_backend
from coopenv.base.errors import CoopenvError
from coopenv.base.installation import list_agents, list_envs
from coopenv.observers import run
from coopenv.observers.recording import Recording
from coopenv.observers.registry import find, named, states_covariance
from coopenv.policies import Policy, agents_for, find_agent, load_policy
from coopenv.runs.console import Progress, compile_notice
from coopenv.runs.rollouts import play
from coopenv.runs.video import frame_stride
from coopenv.scenario import Scenario
from coopenv.viz.scene import Frame, SceneRecord, SceneWriter, Source
from coopenv.viz.scene.record import SCENE_FILE

BASELINE = "route_follower"
MOST_SHOWN = 120.0  # s of a recording on its page, whose frames would be too far apart otherwise


class Keeper:
    """Keeps the frames of an episode that pictures are made of, at most `MAX_FPS` a second."""

    def __init__(self, engine: Engine, source: Source) -> None:
        """Begin with none."""
        scenario = engine.backend.scenario
        self._writer, self._stride = SceneWriter(scenario, source), frame_stride(scenario)
        self.engine = engine
        self._last = -1

    def tick(self, tick: int) -> Frame | None:
        """Keep what is there at a tick if it is one that is drawn, and return it; else None."""
        if tick % self._stride:
            return None
        self._last = tick
        return self._writer.add(self.engine)

    def record(self) -> SceneRecord:
        """Return what has been kept, and what is there now."""
        now = int(self.engine.view("tick")[0])
        if now > self._last:
            self._writer.add(self.engine)
            self._last = now
        return self._writer.record()


def scene_of(
    engine: Engine,
    source: Source,
    policy: Policy | None = None,
    on_progress: Callable[[float], None] = lambda share: None,
    longest: float = np.inf,
) -> SceneRecord:
    """Play an episode in the first world of an engine and return its scene.

    Args:
        engine: any.
        source: what the scene is of; its seed is the episode's.
        policy: drives (None: action zero).
        on_progress: called with the share that is done.
        longest: length, s, after which the episode is broken off.

    Raises:
        CoopenvError: the policy fails, or the backend cannot begin.
    """
    keeper, scenario = Keeper(engine, source), engine.backend.scenario
    ticks = int(min(scenario.horizon_ticks, longest * scenario.rates.camera))
    for tick in play(engine, [source.seed or 0], ticks, policy, to_the_end=False):
        if keeper.tick(tick) is not None:
            on_progress(tick / ticks)
    return keeper.record()


class Onlooker:
    """Keeps the scene of an episode that another loop plays; `on_tick` is called at every tick."""

    def __init__(self, name: str, seed: int, policy: str) -> None:
        """Say what it is of."""
        self._name, self._seed, self._policy = name, seed, policy
        self._keeper: Keeper | None = None

    def on_tick(self, engine: Engine, tick: int) -> None:
        """Look at the engine."""
        if self._keeper is None:
            scenario, recorded = engine.backend.scenario, engine.backend.capabilities.recorded
            policy = self._policy if scenario.driven and not recorded else ""
            seed = None if recorded else self._seed
            self._keeper = Keeper(engine, Source.of(self._name, scenario, seed=seed, policy=policy))
        self._keeper.tick(tick)

    def record(self) -> SceneRecord | None:
        """Return what has been seen; None: nothing."""
        return None if self._keeper is None else self._keeper.record()


def saved_scene(name: str | Path) -> SceneRecord | None:
    """Return the scene in the folder of a run, or of a file `*.npz`; None: the name means something else.

    Raises:
        CoopenvError: the folder is of a run that has kept none, or the file is no scene.
    """
    path = Path(name)
    if str(name) in list_envs():
        return None  # a folder that is called like an environment is ./NAME
    if path.suffix == ".npz":
        return SceneRecord.load(path)
    if (path / SCENE_FILE).is_file():
        return SceneRecord.load(path / SCENE_FILE)
    if any((path / kept).is_file() for kept in ("trajectory.npz", "metrics.json")):
        raise CoopenvError(f"{path}: has no {SCENE_FILE}, which `coopenv run` writes since 0.2; run it again")
    return None


def driver_of(name: str | None, scenario: Scenario, environment: str, seed: int) -> tuple[Policy | None, str]:
    """Return the driver and its name: the given one, else the baseline if it can drive, else none.

    Raises:
        CoopenvError: there is no such agent, or it cannot drive here.
    """
    if not scenario.driven:
        return None, ""
    if name is None:
        known = Path(environment).stem
        name = BASELINE if BASELINE in agents_for(known) or _can_drive(BASELINE, scenario) else "zero"
    return load_policy(name, scenario, seed), Path(name).name


def _can_drive(name: str, scenario: Scenario) -> bool:
    if name not in list_agents():
        return False
    try:
        find_agent(name).policy(scenario)
    except CoopenvError:
        return False
    return True


def open_source(
    name: str,
    overrides: Mapping[str, Any],
    observer: str | None = None,
    data: Path | None = None,
    variant: str | None = None,
    topics: Path | None = None,
) -> Backend:
    """Return where the ticks of a name come from: an environment, a log file, a bag or a data set.

    Raises:
        CoopenvError: there is no such thing, or it is of a form that cannot be opened.
    """
    changes = dict(overrides)
    if observer is not None:
        from coopenv.observers.registry import find, named

        changes["observer.name"] = named(observer)
        find(changes["observer.name"])  # before anything is read
    return open_backend(name, None, changes, data, variant, topics=topics)


def scene_of_recording(
    name: str,
    log: Console,
    observer: str | None = None,
    data: Path | None = None,
    variant: str | None = None,
) -> SceneRecord:
    """Return the scene of a log file or a data set, with progress shown: all of it, or its first `MOST_SHOWN` s.

    Raises:
        CoopenvError: there is no such recording, or the observer fails on it.
    """
    backend = open_source(name, {}, observer, data, variant)
    scenario = backend.scenario
    first = f", first {MOST_SHOWN:g} s of {scenario.horizon:.0f} s" if scenario.horizon > MOST_SHOWN else ""
    source = Source.of(title_of(name) + first, scenario)
    with closing(Engine(scenario, backend=backend)) as engine:
        with compile_notice(log):
            engine.load()
        with Progress(log, "replaying", 1.0) as progress:
            return scene_of(engine, source, None, progress.update, MOST_SHOWN)


def title_of(name: str) -> str:
    """Return what a source is called in headings."""
    path = Path(name)
    return path.name if kind_of(name) in (SourceKind.LOG, SourceKind.BAG) else path.stem


def write_page(record: SceneRecord, path: Path, log: Console, others: Mapping[str, str] | None = None) -> Path | None:
    """Write the page that plays a scene, with progress shown; None, and a line, where the extra `view` is missing.

    `others` are the pages of all drivers by their names, to which this one leads.
    """
    if not pages_can_be_written(path, log):
        return None
    from coopenv.viz.web.page import write_replay

    with Progress(log, f"writing {path.name}", total=1.0) as progress:
        return write_replay(record, path, progress.update, others)


def pages_can_be_written(path: Path, log: Console) -> bool:
    """Return whether the extra `view` is installed; where it is not, a line says so."""
    from coopenv.viz.web.page import has_viser

    if not has_viser():
        log.print(f"note: no {path.name}: pages in the browser need an extra: pip install '.[view]'", soft_wrap=True)
    return has_viser()


_ON_A_PLANE = "planar_robust"
"""Observer of recorded robots unless another one is asked for."""


def check_scene(observer: str | None) -> None:
    """Refuse before any work what `write_log` would refuse. Raises CoopenvError: no such observer, or no SDK."""
    from coopenv.viz.foxglove import check_installed

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
        from coopenv.viz.foxglove import views

        name = named(observer or observer_of(recording))
        with Progress(log, f"estimating with {name}"):
            result = run(name, recording)
        if result.failure:
            raise CoopenvError(f"observer {name} failed: {result.failure}; --no-scene writes the recording alone")
        shown = views(recording, result, start=start, gain=not states_covariance(name))
    with Progress(log, f"writing {path.name}"):
        write_recording(recording, path, views=shown, start=start)
