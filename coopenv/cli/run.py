"""`coopenv run | record`: simulate an environment, or keep what vehicles sense."""

import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from coopenv.base.errors import CoopenvError, DataWarning, OutputError
from coopenv.cli import options

if TYPE_CHECKING:
    from rich.console import Console

    from coopenv.observers.recording import Recording
    from coopenv.runs.scenes import Onlooker


def run(
    environment: options.Source,
    seed: options.Seed = 0,
    overrides: options.Overrides = None,
    steps: Annotated[int | None, typer.Option(min=1, help="Decisions to run (default: up to the horizon).")] = None,
    out: Annotated[Path | None, typer.Option(help="Folder of the results (default: out/ENV).")] = None,
    device: Annotated[str, typer.Option(help="Device that computes: cpu, cuda, cuda:0, ...")] = "cpu",
    dtype: Annotated[str, typer.Option(help="Precision: float32 or float64.")] = "float64",
    policy: options.PolicyName = "zero",
    steady_from: options.SteadyFrom = None,
    figures: Annotated[options.FigureFormat, typer.Option(help="Format of the figures.")] = options.FigureFormat.png,
    width: options.FigureWidth = None,
    no_figures: Annotated[bool, typer.Option("--no-figures", help="Draw no figures and no replay.")] = False,
    video: Annotated[bool, typer.Option("--video", help="Also write a video of the top view.")] = False,
    open_out: Annotated[
        bool,
        typer.Option("--open", help="Show the replay in a browser when it is done; the folder where there is none."),
    ] = False,
    as_json: options.AsJson = False,
    data: options.DataFolder = None,
    variant: options.Variant = None,
    topics: options.TopicMap = None,
) -> None:
    """Run an environment; write metrics, arrays, figures and a page that plays the episode."""
    changes, name = options.parse_overrides(overrides), Path(environment).stem
    refuse_for_recordings(environment, seed=seed, policy=policy)
    backend = options.open_source(environment, changes, data, variant, topics)
    from coopenv.runs.command import REPLAY_FILE, execute, report
    from coopenv.runs.console import compile_notice
    from coopenv.runs.rollouts import Rollout

    folder, form, log = out or Path("out") / name, None if no_figures else figures.value, options.console(stderr=True)
    with compile_notice(log):
        rollout = Rollout(backend.scenario, seed, steps, dtype, device, policy, backend)
    result = execute(name, rollout, folder, log, changes, steady_from, form, video, width=width and width.value)
    if as_json:
        options.print_json(result)
    else:
        report(rollout, result, folder, options.console())
    if open_out:
        page = folder / REPLAY_FILE
        options.show_page(page) if page in result["files"] else options.show(folder)


def refuse_for_recordings(environment: str, seed: int, policy: str) -> None:
    """Refuse options that only a simulation knows where they are given for a recording.

    Of a bag the initial estimates may be drawn.
    """
    from coopenv.backends.sources import is_bag, is_recorded

    for option, value in (("--seed", 0 if is_bag(environment) else seed), ("--policy", policy)):
        if is_recorded(environment) and value not in (0, "zero"):
            raise CoopenvError(f"{option}: is for a simulation, {environment} is recorded")


def record_command(
    environment: options.Source,
    out: Annotated[Path, typer.Option(help="MCAP file to write.")],
    seed: options.Seed = 0,
    policy: options.PolicyName = "zero",
    overrides: options.Overrides = None,
    data: options.DataFolder = None,
    variant: options.Variant = None,
    topics: options.TopicMap = None,
    observer: options.LogObserver = None,
    scene: options.LogScene = True,
    no_replay: Annotated[bool, typer.Option("--no-replay", help="Write no page that plays the episode.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace a file that is there.")] = False,
) -> None:
    """Write what vehicles sense to an MCAP file, and beside it a page that plays the episode.

    The file holds every tick; coopenv replays it, Foxglove and Lichtblick show it with the estimates of an observer.
    """
    from coopenv.backends.mcap import check_target
    from coopenv.backends.sources import is_bag, is_recorded
    from coopenv.runs.log import check_scene, observer_of, write_log
    from coopenv.runs.scenes import Onlooker, pages_can_be_written, scene_of_recording, write_page

    page = out.with_suffix(".html")
    check_target(out)
    if scene:
        check_scene(observer)
    elif observer is not None:
        raise CoopenvError(f"--observer {observer}: is for a scene, --no-scene has none")
    for path in (out, *([] if no_replay else [page])):
        if path.exists() and not force:
            raise OutputError(f"{path}: exists already; --force replaces it")
    changes, log = options.parse_overrides(overrides), options.console(stderr=True)
    onlooker = Onlooker(out.name, seed, policy)
    recording = _recording(environment, seed, policy, changes, (data, variant, topics), onlooker, log)
    write_log(recording, out, log, observer, scene)
    facts = f"{len(recording.setups)} vehicles, {recording.ticks} ticks, {recording.t[-1]:g} s"
    options.console().print(f"{out}: {facts}", soft_wrap=True)
    played = None if no_replay else onlooker.record()
    recorded = is_recorded(environment) and not is_bag(environment, topics)
    if not no_replay and recorded and pages_can_be_written(page, log):
        with warnings.catch_warnings(action="ignore", category=DataWarning):  # what there is to warn of has been said
            played = scene_of_recording(environment, log, observer or observer_of(recording), data, variant)
    if played is not None and write_page(played, page, log) is not None:
        options.console().print(f"{page}: the episode, to watch in a browser", soft_wrap=True)


def _recording(
    environment: str,
    seed: int,
    policy: str,
    changes: dict[str, Any],
    recorded: tuple[Path | None, str | None, Path | None],
    onlooker: "Onlooker",
    log: "Console",
) -> "Recording":
    """Return what vehicles sense, simulated or read; `recorded` are data folder, variant and map of topics."""
    from coopenv.backends.sources import is_bag, is_recorded, open_recording
    from coopenv.runs.console import Progress
    from coopenv.runs.recorder import record

    data, variant, topics = recorded
    if is_bag(environment, topics):
        refuse_for_recordings(environment, seed, policy)
        backend = options.open_source(environment, changes, data, variant, topics)
        with Progress(log, "recording", total=1.0) as progress:
            return record(backend, seed, policy, progress.update, onlooker.on_tick)
    if topics is not None:
        raise CoopenvError(f"--map {topics}: is for ROS bags, {environment} is none")
    if is_recorded(environment):
        refuse_for_recordings(environment, seed, policy)
        if changes:
            raise CoopenvError(f"--set: is for a simulation, {environment} is recorded")
        with options.warned():
            return open_recording(environment, data, variant)
    for option, value in (("--data", data), ("--variant", variant)):
        if value is not None:
            raise CoopenvError(f"{option} {value}: is for recorded data, {environment} is simulated")
    scenario = options.load(environment, changes)
    with Progress(log, "recording", total=1.0) as progress:
        return record(scenario, seed, policy, progress.update, onlooker.on_tick)
